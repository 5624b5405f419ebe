//! What the user holds: one set of actions, bound to the controllers that are common, and asked once a frame.

use glam::Vec2;
use openxr as xr;

use super::Fault;
use super::runtime::Runtime;
use super::space::Spaces;
use crate::hands::{HandInput, Haptic};

/// Left, right.
const HANDS: [&str; 2] = ["/user/hand/left", "/user/hand/right"];

/// Where a kind of controller has what we ask for; paths after `input/`. Empty for what it has not.
struct Profile {
    path: &'static str,
    select: &'static str,
    squeeze: &'static str,
    stick: &'static str,
    /// Left, right: some have a menu on one side only, the other one's being the system's.
    menu: [&'static str; 2],
}

const PROFILES: [Profile; 5] = [
    Profile {
        path: "/interaction_profiles/khr/simple_controller",
        select: "select/click",
        squeeze: "",
        stick: "",
        menu: ["menu/click", "menu/click"],
    },
    Profile {
        path: "/interaction_profiles/oculus/touch_controller",
        select: "trigger/value",
        squeeze: "squeeze/value",
        stick: "thumbstick",
        menu: ["menu/click", "b/click"],
    },
    Profile {
        path: "/interaction_profiles/valve/index_controller",
        select: "trigger/value",
        squeeze: "squeeze/value",
        stick: "thumbstick",
        menu: ["b/click", "b/click"],
    },
    Profile {
        path: "/interaction_profiles/htc/vive_controller",
        select: "trigger/value",
        squeeze: "squeeze/click",
        stick: "trackpad",
        menu: ["menu/click", "menu/click"],
    },
    Profile {
        path: "/interaction_profiles/microsoft/motion_controller",
        select: "trigger/value",
        squeeze: "squeeze/click",
        stick: "thumbstick",
        menu: ["menu/click", "menu/click"],
    },
];

/// One of both hands.
struct Side {
    path: xr::Path,
    grip: xr::Space,
    aim: xr::Space,
}

/// Both controllers of a session.
pub(super) struct Controllers {
    sides: [Side; 2],
    actions: Actions,
    set: xr::ActionSet,
    /// Profiles that were said to be in use.
    in_use: [Option<String>; 2],
}

struct Actions {
    grip: xr::Action<xr::Posef>,
    aim: xr::Action<xr::Posef>,
    select: xr::Action<f32>,
    squeeze: xr::Action<f32>,
    stick: xr::Action<xr::Vector2f>,
    menu: xr::Action<bool>,
    pulse: xr::Action<xr::Haptic>,
}

impl Controllers {
    /// Declares the actions and attaches them to the session.
    ///
    /// # Errors
    /// Those of [`Fault::of`].
    pub(super) fn new(runtime: &Runtime, session: &xr::Session<xr::Vulkan>) -> Result<Self, Fault> {
        let failed = |code| Fault::of("setting up the controllers", code);
        let instance = &runtime.instance;
        let set = instance.create_action_set("mr360", "MR360 live", 0).map_err(failed)?;
        let paths = [path(instance, HANDS[0])?, path(instance, HANDS[1])?];
        let actions = Actions {
            grip: set.create_action("grip", "Hold", &paths).map_err(failed)?,
            aim: set.create_action("aim", "Point", &paths).map_err(failed)?,
            select: set.create_action("select", "Take", &paths).map_err(failed)?,
            squeeze: set.create_action("squeeze", "Grip", &paths).map_err(failed)?,
            stick: set.create_action("stick", "Push, pull, turn", &paths).map_err(failed)?,
            menu: set.create_action("menu", "Library", &paths).map_err(failed)?,
            pulse: set.create_action("pulse", "Pulse", &paths).map_err(failed)?,
        };
        let mut known = 0;
        for profile in &PROFILES {
            // A runtime need not know every controller there is.
            match instance.suggest_interaction_profile_bindings(path(instance, profile.path)?, &actions.bindings(instance, profile)?) {
                Ok(()) => known += 1,
                Err(code) => tracing::info!(controller = profile.path, ?code, "controller not known to the runtime"),
            }
        }
        tracing::info!("{known} of {} kinds of controllers bound", PROFILES.len());
        session.attach_action_sets(&[&set]).map_err(failed)?;
        let side = |path| -> Result<Side, Fault> {
            Ok(Side {
                path,
                grip: actions.grip.create_space(session, path, xr::Posef::IDENTITY).map_err(failed)?,
                aim: actions.aim.create_space(session, path, xr::Posef::IDENTITY).map_err(failed)?,
            })
        };
        Ok(Self { sides: [side(paths[0])?, side(paths[1])?], actions, set, in_use: [None, None] })
    }

    /// How both hands are at a time of the display.
    ///
    /// # Errors
    /// The runtime's.
    pub(super) fn read(
        &self,
        session: &xr::Session<xr::Vulkan>,
        spaces: &Spaces,
        at: xr::Time,
        ground_y: f32,
    ) -> Result<[HandInput; 2], xr::sys::Result> {
        session.sync_actions(&[xr::ActiveActionSet::new(&self.set)])?;
        let mut hands = [HandInput::default(); 2];
        for (hand, side) in hands.iter_mut().zip(&self.sides) {
            let Actions { select, squeeze, stick, menu, .. } = &self.actions;
            let stick = stick.state(session, side.path)?.current_state;
            *hand = HandInput {
                grip: spaces.locate(&side.grip, at, ground_y)?,
                aim: spaces.locate(&side.aim, at, ground_y)?,
                select: known(&select.state(session, side.path)?),
                squeeze: known(&squeeze.state(session, side.path)?),
                stick: Vec2::new(signed(stick.x), signed(stick.y)),
                menu: menu.state(session, side.path)?.current_state,
            };
        }
        Ok(hands)
    }

    /// Plays pulses, left and right.
    ///
    /// # Errors
    /// The runtime's.
    pub(super) fn pulse(&self, session: &xr::Session<xr::Vulkan>, haptics: [Option<Haptic>; 2]) -> Result<(), xr::sys::Result> {
        for (haptic, side) in haptics.iter().zip(&self.sides) {
            let Some(Haptic { amplitude, duration_us }) = *haptic else { continue };
            let nanoseconds = i64::try_from(duration_us.saturating_mul(1_000)).unwrap_or(i64::MAX);
            let vibration = xr::HapticVibration::new()
                .amplitude(unit(amplitude))
                .duration(xr::Duration::from_nanos(nanoseconds))
                .frequency(xr::FREQUENCY_UNSPECIFIED);
            self.actions.pulse.apply_feedback(session, side.path, &vibration)?;
        }
        Ok(())
    }

    /// Says which controllers are in use, when that has changed.
    pub(super) fn log_in_use(&mut self, runtime: &Runtime, session: &xr::Session<xr::Vulkan>) {
        for ((name, side), in_use) in ["left", "right"].into_iter().zip(&self.sides).zip(&mut self.in_use) {
            let profile = session.current_interaction_profile(side.path).ok().filter(|profile| *profile != xr::Path::NULL);
            let profile = profile.and_then(|profile| runtime.instance.path_to_string(profile).ok());
            if *in_use != profile {
                tracing::info!(hand = name, controller = profile.as_deref().unwrap_or("none"), "controller");
                *in_use = profile;
            }
        }
    }
}

impl Actions {
    fn bindings(&self, instance: &xr::Instance, profile: &Profile) -> Result<Vec<xr::Binding<'_>>, Fault> {
        let mut bindings = Vec::new();
        for (hand, menu) in HANDS.into_iter().zip(profile.menu) {
            let at = |end: &str| path(instance, &format!("{hand}/{end}"));
            let input = |end: &str| path(instance, &format!("{hand}/input/{end}"));
            bindings.push(xr::Binding::new(&self.grip, input("grip/pose")?));
            bindings.push(xr::Binding::new(&self.aim, input("aim/pose")?));
            bindings.push(xr::Binding::new(&self.select, input(profile.select)?));
            bindings.push(xr::Binding::new(&self.menu, input(menu)?));
            bindings.push(xr::Binding::new(&self.pulse, at("output/haptic")?));
            if !profile.squeeze.is_empty() {
                bindings.push(xr::Binding::new(&self.squeeze, input(profile.squeeze)?));
            }
            if !profile.stick.is_empty() {
                bindings.push(xr::Binding::new(&self.stick, input(profile.stick)?));
            }
        }
        Ok(bindings)
    }
}

fn path(instance: &xr::Instance, text: &str) -> Result<xr::Path, Fault> {
    instance.string_to_path(text).map_err(|code| Fault::of("naming a control", code))
}

/// Without focus, or with a controller that is off, states are inactive and read 0: that is no button let go of.
fn known(state: &xr::ActionState<f32>) -> f32 {
    if state.is_active { unit(state.current_state) } else { f32::NAN }
}

fn unit(value: f32) -> f32 {
    if value.is_finite() { value.clamp(0.0, 1.0) } else { 0.0 }
}

fn signed(value: f32) -> f32 {
    if value.is_finite() { value.clamp(-1.0, 1.0) } else { 0.0 }
}
