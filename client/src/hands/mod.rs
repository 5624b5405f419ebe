//! Hands: point, grab, move, turn, scale, throw, release, place. No runtime, no GPU and no clock in here: time is an argument.

pub mod input;

use mr360_protocol::scene::{Action, Geometry, Material, ObjectId, Transform};

use crate::scene::pick::Ray;
pub use input::{HandInput, HandsInput, Haptic, Pose};

/// What hands and pointers ask of the scene that this viewer shows.
pub trait World {
    /// The nearest object along a ray and where it is met.
    fn pick(&self, ray: &Ray) -> Option<(ObjectId, glam::Vec3)>;

    /// The object nearest to a point whose bounds are within `reach_m` of it.
    fn near(&self, point: glam::Vec3, reach_m: f32) -> Option<ObjectId>;

    /// Where an object is, as this viewer shows it.
    fn transform(&self, object: ObjectId) -> Option<Transform>;

    /// Height of the ground, metres.
    fn ground_y(&self) -> f32;
}

/// Something that only this viewer sees: a controller, a ray, the ghost of what is about to be placed.
#[derive(Debug, Clone, PartialEq)]
pub struct LocalObject {
    /// Its form; a shape, or a model that the scene's library names.
    pub geometry: Geometry,
    /// Its place.
    pub transform: Transform,
    /// Its surface.
    pub material: Material,
}

/// What a frame's input came to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HandsOutput {
    /// Wishes for the server, in order. Hand each to `Stage::predict` too, so that this viewer sees it without the round trip.
    pub actions: Vec<Action>,
    /// Pulses to play now, left and right.
    pub haptics: [Option<Haptic>; 2],
    /// Hands, rays, palette and ghost, for `Stage::show_local`.
    pub drawn: Vec<LocalObject>,
}

/// Both hands over time.
#[derive(Debug, Default)]
pub struct Hands {
    previous: Option<HandsInput>,
}

impl Hands {
    /// Takes in the hands of one frame.
    pub fn update(&mut self, input: &HandsInput, world: &impl World) -> HandsOutput {
        let _ = world.ground_y();
        self.previous = Some(*input);
        HandsOutput::default()
    }
}
