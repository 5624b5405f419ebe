//! The renderer, as the frame loop sees it.

use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::Action;
use mr360_protocol::light::LightFrame;

use super::{FrameError, Shot};
use crate::governor::Tier;
use crate::hands::{LocalObject, World};
use crate::stats::{FrameTimes, PassTime};
use crate::sync::Paired;
use crate::view::Plan;

/// What drawing a view came to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Drawn {
    /// GPU times known by now, those of an earlier frame included.
    pub passes: Vec<PassTime>,
    /// How much was left out.
    pub tier: Tier,
    /// What was done.
    pub plan: Plan,
}

/// The renderer, as the frame loop sees it.
pub trait Stage: World {
    /// Takes in what came for the scene since the last turn; true when the view looks different for it.
    ///
    /// # Errors
    /// [`FrameError::DeviceLost`], or whatever keeps it from drawing on.
    fn prepare(&mut self) -> Result<bool, FrameError>;

    /// Uploads a picture and submits what depends on the video alone. Without a light, objects are to be hidden.
    ///
    /// # Errors
    /// As [`Stage::prepare`].
    fn update(&mut self, paired: Paired) -> Result<(), FrameError>;

    /// Lights objects from the next frame on by this light, which lies between that of the picture and the next one's. True when the view
    /// looks different for it.
    fn relight(&mut self, light: &LightFrame) -> bool;

    /// Draws a frame of one or more views and submits it.
    ///
    /// # Errors
    /// As [`Stage::prepare`].
    fn draw(&mut self, shots: &[Shot]) -> Result<Drawn, FrameError>;

    /// The display shows a frame every so many microseconds.
    fn set_interval(&mut self, _interval_us: u32) {}

    /// Shows what a frame costs over the view, or no longer.
    fn toggle_overlay(&mut self) {}

    /// Told of every frame once it was presented.
    fn presented(&mut self, _times: &FrameTimes) {}

    /// Shows what mouse and keys do over the view, or no longer.
    fn toggle_controls(&mut self) {}

    /// Why the device was lost, once it is.
    fn device_lost(&self) -> Option<String>;

    /// True once the scene has come that wishes are about.
    fn has_scene(&self) -> bool;

    /// Shows at once what this user does, without the server's word.
    fn predict(&mut self, action: &Action, now: ClientTime);

    /// Shows these beside the scene from the next frame on, to this viewer alone: the user's hands, and what they point with.
    fn show_local(&mut self, objects: &[LocalObject]);

    /// As [`Stage::show_local`], beside it: those of a script that is played.
    fn show_script(&mut self, _objects: &[LocalObject]) {}
}
