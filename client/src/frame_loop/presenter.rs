//! Whoever shows frames: a headset, a window, or nobody.

use mr360_protocol::clock::ClientTime;

use super::FrameError;
use crate::camera::Camera;

/// Where a view is drawn to.
pub struct Target {
    /// A colour attachment.
    pub view: wgpu::TextureView,
    /// Both eyes' together, where they are layers of one texture.
    pub both: Option<wgpu::TextureView>,
    /// Its format.
    pub format: wgpu::TextureFormat,
    /// A depth attachment of [`DEPTH_FORMAT`](crate::view::DEPTH_FORMAT) and the same size, where whoever presents asks for depth: 1 at [`Camera::NEAR_M`], 0 at infinity.
    pub depth: Option<wgpu::TextureView>,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// One view of a frame. All of a frame have targets of one format.
pub struct Shot {
    /// From where.
    pub camera: Camera,
    /// Where to.
    pub target: Target,
}

/// What presenting a frame came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Presented {
    /// How often this thread stood still for the GPU, or for pictures that are still shown, within the frame. What a headset's runtime does in
    /// its own calls is not seen from here.
    pub gpu_waits: u64,
    /// Of a headset.
    pub headset: Option<HeadsetTimes>,
}

/// What only a headset's frames have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct HeadsetTimes {
    /// From reading the pose that the frame was drawn for to when the runtime predicts its light to leave the display, microseconds, 0 when
    /// that was over; `None` where the runtime's clock cannot be read.
    pub pose_to_photon_us: Option<u64>,
    /// From the runtime's call for the frame to handing it over, microseconds: whatever is waited for within a frame is in it.
    pub frame_us: u64,
    /// Display intervals since the start that no new frame came for.
    pub missed: u64,
}

/// When a picture is, in the time of its broadcast.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureTime {
    /// Which broadcast, as [`Playout::epoch`](crate::sync::Playout::epoch) counts them; a later one's time begins anew.
    pub epoch: u64,
    /// Within the broadcast, microseconds.
    pub pts_us: u64,
}

/// Shows frames: in a headset, in a window, or to nobody.
pub trait Presenter {
    /// The next frame's views, or `None` when there is nowhere to draw just now (hidden window, resize under way): the frame is skipped.
    /// They are from `camera`, unless whoever presents knows better where the viewer is; then this is the last moment to ask.
    ///
    /// # Errors
    /// [`FrameError::DeviceLost`] when everything has to be opened anew.
    fn acquire(&mut self, camera: &Camera) -> Result<Option<Vec<Shot>>, FrameError>;

    /// Presents what was drawn to the targets acquired last, of the picture `shown`. `now` is when the drawing was submitted.
    ///
    /// # Errors
    /// As [`Presenter::acquire`].
    fn present(&mut self, shown: PictureTime, now: ClientTime) -> Result<Presented, FrameError>;
}
