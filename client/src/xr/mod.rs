//! Presents in a headset, through whatever OpenXR runtime the user has.
//!
//! The runtime sets the pace. A frame waits for it and for nothing else: what came from the network and the decoder is taken in, poses are read
//! last, both eyes are drawn and handed over. Runtime and headset may come, sleep, go and come back while the broadcast runs on; all that hangs
//! on them, the GPU's device included, is then made anew.

mod controllers;
mod eyes;
mod fault;
mod graphics;
mod headset;
mod layers;
mod pace;
mod runtime;
mod space;
mod spectator;
mod swapchain;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Action;

pub use self::eyes::EyeRecorder;
pub use self::spectator::Spectator;

use self::fault::Fault;
use self::headset::{Headset, Standing, Viewer, Watchers};
use self::runtime::{Loader, Runtime};
use self::spectator::Watching;
use crate::camera::Camera;
use crate::frame_loop::{BoxError, FrameError, FrameLoop, Redraw, Stage};
use crate::gpu::Gpu;
use crate::hands::Hands;

/// From one look for a headset to the next.
const RETRY: Duration = Duration::from_secs(2);
/// From one question to a session that wants no frames to the next.
const LISTEN: Duration = Duration::from_millis(10);
/// From one look after the spectators' window to the next while there is no session.
const ATTEND: Duration = Duration::from_millis(100);
/// Sessions in a row that were lost before they showed anything, after which the headset is given up.
const MAX_LOST: u32 = 3;

/// When a run ends.
#[derive(Debug, Clone)]
pub struct XrOptions {
    /// After so many frames.
    pub frames: Option<u64>,
    /// After so long.
    pub duration: Option<Duration>,
    /// When set, as by Ctrl-C; set when the user ends the program from within the headset.
    pub stop: Arc<AtomicBool>,
}

/// Why there is no headset, or no longer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum XrError {
    /// Nothing that waiting would mend: fall back to another mode.
    #[error("no headset can be used: {detail}")]
    NoHeadset {
        /// What is missing, and where it comes from.
        detail: String,
    },
    /// The renderer could not be set up on the headset's GPU.
    #[error("the renderer cannot be set up on the headset's GPU: {0}")]
    Open(BoxError),
    /// A frame could not be drawn.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// A call to the runtime failed that should not.
    #[error("the OpenXR runtime failed: {detail}; restart the headset's software")]
    Runtime {
        /// Which, and how.
        detail: String,
    },
}

/// What a run asks of its surroundings.
pub struct Surroundings<'a, S> {
    /// Makes the renderer on the headset's GPU, and again when it was lost.
    pub open: &'a mut dyn FnMut(Gpu) -> Result<S, BoxError>,
    /// Hands on to the server what the user wishes; must not block.
    pub act: &'a mut dyn FnMut(Action),
    /// Keeps what the eyes saw.
    pub eyes: Option<EyeRecorder>,
    /// Shows what the left eye sees to those beside.
    pub spectator: Option<&'a mut Spectator>,
}

/// Shows frames in a headset until an end of `options` is reached, the stream ends or the user leaves; then returns the frames presented. While
/// there is no headset the broadcast runs on unseen, and it is looked for again and again.
///
/// # Errors
/// [`XrError::NoHeadset`] when waiting would be in vain; everything else ends a run.
pub fn run<S: Stage>(frames: &mut FrameLoop, options: &XrOptions, mut surroundings: Surroundings<'_, S>) -> Result<u64, XrError> {
    let limits = Limits { options, begin: Instant::now(), first_frame: frames.frames() };
    let loader = Loader::load().map_err(given_up)?;
    let mut viewer = Viewer::default();
    let mut patience = Patience::default();
    while !limits.are_reached(frames) {
        let before = frames.frames();
        let Err(fault) = session(frames, &limits, &loader, &mut surroundings, &mut viewer) else { break };
        frames.device_lost();
        if let Some(news) = patience.after(fault, frames.frames() > before)? {
            tracing::warn!("{news}; the broadcast goes on");
        }
        // The session has let go of it; its window would seem to hang.
        let mut attend = || {
            if let Some(spectator) = surroundings.spectator.as_deref_mut() {
                spectator.attend();
            }
        };
        if pass_for(frames, &limits, RETRY, &mut attend) {
            break;
        }
    }
    Ok(frames.frames() - limits.first_frame)
}

/// What to make of sessions that end.
#[derive(Debug, Default)]
struct Patience {
    /// Said last.
    told: Option<String>,
    /// In a row that were lost before they showed anything.
    lost: u32,
}

impl Patience {
    /// What there is to say of a session that this ended, before the next is begun: nothing where that was said already.
    ///
    /// # Errors
    /// Where no other is worth beginning.
    fn after(&mut self, fault: Fault, showed: bool) -> Result<Option<String>, XrError> {
        if showed {
            *self = Self::default();
        }
        let detail = match fault {
            Fault::Later(detail) => detail,
            Fault::Lost(detail) | Fault::Frame(FrameError::DeviceLost { detail }) => {
                // This has happened, even if it happened before.
                self.told = None;
                self.lost += 1;
                if self.lost >= MAX_LOST {
                    return Err(XrError::NoHeadset { detail: format!("{detail}, {MAX_LOST} times in a row") });
                }
                format!("{detail}; opening it anew")
            }
            fault => return Err(given_up(fault)),
        };
        let news = self.told.as_ref() != Some(&detail);
        self.told = Some(detail.clone());
        Ok(news.then_some(detail))
    }
}

fn given_up(fault: Fault) -> XrError {
    match fault {
        Fault::Absent(detail) => XrError::NoHeadset { detail },
        Fault::Open(error) => XrError::Open(error),
        Fault::Frame(error) => XrError::Frame(error),
        Fault::Later(detail) | Fault::Lost(detail) | Fault::Failed(detail) => XrError::Runtime { detail },
    }
}

struct Limits<'a> {
    options: &'a XrOptions,
    begin: Instant,
    first_frame: u64,
}

impl Limits<'_> {
    fn are_reached(&self, frames: &FrameLoop) -> bool {
        let done = frames.frames() - self.first_frame;
        let over =
            self.options.frames.is_some_and(|most| done >= most) || self.options.duration.is_some_and(|most| self.begin.elapsed() >= most);
        over || self.options.stop.load(Ordering::Relaxed)
    }
}

/// Lets the broadcast run on unseen for a while, and calls `attend` at least once each [`ATTEND`]. True when the run is over.
fn pass_for(frames: &mut FrameLoop, limits: &Limits<'_>, time: Duration, attend: &mut dyn FnMut()) -> bool {
    let after = |now: ClientTime, time: Duration| ClientTime(now.0 + time.as_micros() as u64);
    let mut now = frames.clock().now();
    let until = after(now, time);
    while now < until {
        attend();
        if frames.pass().ended || limits.are_reached(frames) {
            return true;
        }
        frames.rest(Some(until.min(after(now, ATTEND))));
        now = frames.clock().now();
    }
    false
}

/// From finding a headset until the run is over.
fn session<S: Stage>(
    frames: &mut FrameLoop,
    limits: &Limits<'_>,
    loader: &Loader,
    surroundings: &mut Surroundings<'_, S>,
    viewer: &mut Viewer,
) -> Result<(), Fault> {
    let runtime = Runtime::open(loader)?;
    let (gpu, handles) = graphics::open(&runtime)?;
    let Surroundings { open, act, eyes, spectator } = surroundings;
    let watchers = Watchers { eyes: eyes.as_mut(), spectator: spectator.as_deref_mut().map(|spectator| Watching::new(spectator, &gpu)) };
    let mut headset = Headset::new(runtime, &gpu, &handles, frames.clock(), viewer, watchers)?;
    let mut stage = open(gpu).map_err(Fault::Open)?;
    let mut hands = Hands::default();
    let outcome = present(frames, limits, &mut headset, &mut stage, &mut hands, act);
    // Whatever ended it, nobody is left with these hands.
    wish(hands.let_go_of_all(), frames.clock().now(), &mut stage, act);
    outcome
}

/// Wishes that are shown at once and decided by the server.
fn wish(actions: Vec<Action>, now: ClientTime, stage: &mut impl Stage, act: &mut dyn FnMut(Action)) {
    actions.iter().for_each(|action| stage.predict(action, now));
    actions.into_iter().for_each(act);
}

/// Frames, until the run or the session is over.
fn present<S: Stage>(
    frames: &mut FrameLoop,
    limits: &Limits<'_>,
    headset: &mut Headset<'_>,
    stage: &mut S,
    hands: &mut Hands,
    act: &mut dyn FnMut(Action),
) -> Result<(), Fault> {
    while !limits.are_reached(frames) {
        wish(hands.let_go_when_idle(frames.clock().now()), frames.clock().now(), stage, act);
        let ended = match headset.listen(stage.ground_y()).map_err(Fault::within_session)? {
            Standing::Running => frame(frames, headset, stage, hands, act).map_err(Fault::within_session)?,
            // Listening to the headset attends to the spectators.
            Standing::Stopped => pass_for(frames, limits, LISTEN, &mut || {}),
            Standing::Ended => {
                limits.options.stop.store(true, Ordering::Relaxed);
                true
            }
        };
        if ended {
            break;
        }
    }
    Ok(())
}

/// One frame of a session that wants frames. True when the stream has ended.
fn frame<S: Stage>(
    frames: &mut FrameLoop,
    headset: &mut Headset<'_>,
    stage: &mut S,
    hands: &mut Hands,
    act: &mut dyn FnMut(Action),
) -> Result<bool, Fault> {
    let turn = if let Some(interval) = headset.begin()? {
        // A runtime that does not know its display's period says 0.
        if !interval.is_zero() {
            stage.set_interval(u32::try_from(interval.as_micros()).unwrap_or(u32::MAX));
        }
        let out = hands.update(&headset.read_hands()?, stage);
        headset.pulse(out.haptics)?;
        headset.place(&out.placing);
        stage.show_local(&out.drawn);
        wish(out.actions, frames.clock().now(), stage, act);
        // Where the viewer is comes from the headset; this camera is nobody's.
        frames.turn(stage, headset, &Camera::looking(0.0, 0.0, 1.0), Redraw::Always).map_err(Fault::Frame)
    } else {
        Ok(frames.pass())
    };
    headset.end_unseen()?;
    Ok(turn?.ended)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device_lost() -> Fault {
        Fault::Frame(FrameError::DeviceLost { detail: "the driver gave it up".to_owned() })
    }

    #[test]
    fn what_is_waited_for_is_said_once() {
        let mut patience = Patience::default();
        let away = || Fault::Later("no headset is connected".to_owned());
        assert_eq!(patience.after(away(), false).unwrap().as_deref(), Some("no headset is connected"));
        for _ in 0..2 * MAX_LOST {
            assert_eq!(patience.after(away(), false).unwrap(), None);
        }
        // There, and away again.
        assert!(patience.after(away(), true).unwrap().is_some());
        assert!(patience.after(Fault::Later("start its software".to_owned()), false).unwrap().is_some());
    }

    #[test]
    fn a_lost_gpu_is_opened_anew_until_nothing_is_shown_in_between() {
        let mut patience = Patience::default();
        for _ in 0..3 * MAX_LOST {
            let news = patience.after(device_lost(), true).unwrap().unwrap();
            assert!(news.contains("the driver gave it up") && news.contains("anew"), "{news}");
        }
        for _ in 1..MAX_LOST - 1 {
            assert!(patience.after(device_lost(), false).unwrap().is_some());
        }
        assert!(matches!(patience.after(device_lost(), false), Err(XrError::NoHeadset { detail }) if detail.contains("in a row")));
    }

    #[test]
    fn the_spectators_are_attended_to_again_and_again_while_there_is_no_session() {
        let (mut frames, feeder) = crate::headless::tests::endless_frame_loop();
        let options = XrOptions { frames: None, duration: None, stop: Arc::default() };
        let limits = Limits { options: &options, begin: Instant::now(), first_frame: 0 };
        let mut attended = 0;
        let over = pass_for(&mut frames, &limits, Duration::from_secs(60), &mut || {
            attended += 1;
            options.stop.store(attended == 3, Ordering::Relaxed);
        });
        assert_eq!((over, attended), (true, 3));
        drop(frames);
        feeder.join().unwrap();
    }

    #[test]
    fn what_waiting_does_not_mend_ends_the_run() {
        let mut patience = Patience::default();
        assert!(matches!(patience.after(Fault::Absent("no runtime".to_owned()), false), Err(XrError::NoHeadset { .. })));
        assert!(matches!(patience.after(Fault::Failed("odd".to_owned()), true), Err(XrError::Runtime { .. })));
        assert!(matches!(patience.after(Fault::Open("no shader".into()), false), Err(XrError::Open(_))));
    }
}
