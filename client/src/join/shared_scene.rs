//! The session's scene and models, written by the network's thread and read by the frame loop.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use mr360_protocol::asset::AssetId;
use mr360_protocol::clock::{ClientTime, ServerTime};
use mr360_protocol::intent::Action;
use mr360_protocol::scene::{ApplyError, Change, Object, ObjectId, Scene, SceneMessage, Transform};

use crate::scene::model::{LoadedModel, ModelError};
use crate::sync::{ClientClock, Motions};

/// Most bytes of memory for all models together.
const MAX_MODEL_BYTES: usize = 2 * 1024 * 1024 * 1024;

/// Shared between both threads; the lock is held for moments.
#[derive(Clone)]
pub struct SharedScene {
    state: Arc<Mutex<SceneState>>,
    clock: ClientClock,
}

#[derive(Default)]
struct SceneState {
    shown: Shown,
    motions: Motions,
    /// The scene is of this broadcast, not of an earlier one of the room.
    current: bool,
}

/// What there is to show.
#[derive(Default, Clone)]
pub(super) struct Shown {
    /// Shared with the frame loop, which keeps the one it draws: changes are made to a copy then.
    pub(super) scene: Arc<Scene>,
    pub(super) models: Arc<HashMap<AssetId, LoadedModel>>,
    /// Counts changes of either, but for objects that only move.
    pub(super) version: u64,
}

impl SharedScene {
    /// An empty scene; times are this clock's.
    #[must_use]
    pub fn new(clock: ClientClock) -> Self {
        Self { state: Arc::default(), clock }
    }

    fn lock(&self) -> MutexGuard<'_, SceneState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The clock of all times in here.
    #[must_use]
    pub fn clock(&self) -> ClientClock {
        self.clock
    }

    /// What comes from now on is of another broadcast, whose clock is another: nothing is known of how its objects move. The old scene is
    /// shown until it comes.
    pub fn new_broadcast(&self) {
        let mut state = self.lock();
        (state.motions, state.current) = (Motions::default(), false);
    }

    /// Takes in a message of the scene track, which has just come.
    ///
    /// # Errors
    /// When a delta does not follow; the next snapshot heals that.
    pub fn apply(&self, message: &SceneMessage) -> Result<(), ApplyError> {
        let now = self.clock.now();
        let mut state = self.lock();
        let SceneState { shown, motions, current } = &mut *state;
        let before = Arc::clone(&shown.scene);
        Arc::make_mut(&mut shown.scene).apply(message)?;
        match message {
            SceneMessage::Snapshot { at_us, scene } => {
                let known = std::mem::replace(current, true);
                motions.snapshot(ServerTime(*at_us), now, scene, if known { &before } else { scene });
                shown.version += u64::from(!known || differs_but_in_places(&before, scene));
            }
            SceneMessage::Delta { at_us, changes, .. } => {
                motions.delta(ServerTime(*at_us), now, changes, &before);
                shown.version += u64::from(changes.iter().any(|change| !matches!(change, Change::Move(..))));
            }
        }
        Ok(())
    }

    /// Takes in a model. Where all together would take too much memory, those that no object shows go first.
    pub fn add_model(&self, id: AssetId, model: LoadedModel) {
        let mut state = self.lock();
        let shown = &mut state.shown;
        let bytes = |model: &LoadedModel| model.as_ref().map_or(0, |model| model.bytes());
        let room = MAX_MODEL_BYTES.saturating_sub(bytes(&model));
        let models = Arc::make_mut(&mut shown.models);
        if models.values().map(bytes).sum::<usize>() > room {
            let needed = shown.scene.assets();
            models.retain(|id, _| needed.contains(id));
        }
        let fits = models.values().map(bytes).sum::<usize>() <= room;
        let too_large = ModelError::TooLarge { what: "bytes of memory with the scene's other models", limit: MAX_MODEL_BYTES };
        models.insert(id, if fits { model } else { Err(too_large) });
        shown.version += 1;
    }

    /// What there is to show now; the lock is not held any longer.
    pub(super) fn shown(&self) -> Shown {
        self.lock().shown.clone()
    }

    /// Counts changes that need the scene to be laid out anew.
    pub(super) fn version(&self) -> u64 {
        self.lock().shown.version
    }

    /// Objects are on their way: the next frame looks different.
    pub(super) fn moving(&self) -> bool {
        self.lock().motions.moving()
    }

    /// Objects that are shown elsewhere than the scene has them. Once a frame.
    pub(super) fn advance(&self, now: ClientTime) -> Vec<(ObjectId, Transform)> {
        let mut state = self.lock();
        let SceneState { shown, motions, .. } = &mut *state;
        motions.advance(now, &shown.scene)
    }

    /// This user does something with an object that is shown there.
    pub(super) fn lead(&self, action: &Action, shown: Option<Transform>, now: ClientTime) {
        self.lock().motions.lead(action, shown, now);
    }
}

/// More is different than where objects are.
fn differs_but_in_places(before: &Scene, after: &Scene) -> bool {
    let alike = |a: &Object, b: &Object| (a.id, &a.geometry, &a.material, &a.animation) == (b.id, &b.geometry, &b.material, &b.animation);
    let same_objects = before.objects.len() == after.objects.len() && before.objects.iter().zip(&after.objects).all(|(a, b)| alike(a, b));
    let rest = |scene: &Scene| (scene.ground_y, scene.ground);
    !same_objects || rest(before) != rest(after) || before.place != after.place || before.library != after.library
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use mr360_protocol::scene::Geometry;

    use super::*;
    use crate::scene::mesh::{Bounds, Mesh};
    use crate::scene::model::Model;

    fn model(indices: usize) -> LoadedModel {
        let mesh = Mesh { vertices: Vec::new(), indices: vec![0; indices] };
        let parts = vec![crate::scene::model::Part { mesh, ..Default::default() }];
        Ok(Arc::new(Model { parts, textures: Vec::new(), bounds: Bounds::EMPTY, rig: None }))
    }

    fn snapshot(geometry: Geometry) -> SceneMessage {
        let object = Object { id: ObjectId(1), geometry, transform: Transform::default(), material: None, animation: Default::default() };
        SceneMessage::Snapshot { at_us: 0, scene: Scene { objects: vec![object], ..Scene::default() } }
    }

    #[test]
    fn what_the_frame_loop_holds_does_not_change_under_it() {
        let shared = SharedScene::new(ClientClock::start());
        let id = AssetId::of(b"a");
        shared.apply(&snapshot(Geometry::Model(id))).unwrap();
        let before = shared.shown();
        shared.add_model(id, model(3));
        shared.apply(&SceneMessage::Snapshot { at_us: 0, scene: Scene::default() }).unwrap();
        assert_eq!((before.scene.objects.len(), before.models.len(), before.version), (1, 0, 1));
        let after = shared.shown();
        assert_eq!((after.scene.objects.len(), after.models.len(), after.version), (0, 1, 3));
        // Nothing changed: the same scene and models, not copies of them.
        assert!(Arc::ptr_eq(&after.scene, &shared.shown().scene) && Arc::ptr_eq(&after.models, &shared.shown().models));
    }

    #[test]
    fn models_that_nobody_shows_make_room_and_too_many_are_refused() {
        let shared = SharedScene::new(ClientClock::start());
        let [shown, unseen, third, fourth] = [b"a", b"b", b"c", b"d"].map(|name| AssetId::of(name));
        shared.apply(&snapshot(Geometry::Model(shown))).unwrap();
        // Zeroed memory that nobody reads costs none.
        let large = || model(MAX_MODEL_BYTES / 4 / 2);
        shared.add_model(shown, large());
        shared.add_model(unseen, large());
        shared.add_model(third, model(3));
        let models = shared.shown().models;
        assert!(models.contains_key(&shown) && !models.contains_key(&unseen) && models[&third].is_ok());
        shared.add_model(fourth, model(MAX_MODEL_BYTES / 4 / 2 + 1));
        assert!(matches!(shared.shown().models[&fourth], Err(ModelError::TooLarge { .. })));
    }

    #[test]
    fn what_only_moves_is_not_laid_out_anew() {
        let shared = SharedScene::new(ClientClock::start());
        shared.apply(&snapshot(Geometry::Shape(mr360_protocol::scene::Shape::Cube))).unwrap();
        let version = shared.version();
        let to = Transform { position: Vec3::X, ..Transform::default() };
        let delta = |revision, changes| SceneMessage::Delta { revision, at_us: 1_000_000, changes };
        shared.apply(&delta(1, vec![Change::Move(ObjectId(1), to)])).unwrap();
        assert_eq!((shared.version(), shared.shown().scene.objects[0].transform), (version, to));
        assert!(shared.moving());
        // A delta that was lost moves nothing.
        assert!(shared.apply(&delta(3, vec![Change::Remove(ObjectId(1))])).is_err());
        assert_eq!((shared.version(), shared.shown().scene.objects.len()), (version, 1));
        shared.apply(&delta(2, vec![Change::Remove(ObjectId(1))])).unwrap();
        assert_eq!((shared.version(), shared.moving()), (version + 1, false));
    }

    #[test]
    fn a_snapshot_amid_a_flight_lays_nothing_out_anew_and_a_new_broadcast_begins_from_nothing() {
        let shared = SharedScene::new(ClientClock::start());
        let at = |x: f32, at_us| {
            let SceneMessage::Snapshot { mut scene, .. } = snapshot(Geometry::Shape(mr360_protocol::scene::Shape::Cube)) else { panic!() };
            scene.objects[0].transform.position.x = x;
            SceneMessage::Snapshot { at_us, scene }
        };
        shared.apply(&at(0.0, 90_000_000)).unwrap();
        assert!(!shared.moving(), "the first says where all stands");
        let version = shared.version();
        shared.apply(&at(1.0, 90_016_667)).unwrap();
        assert_eq!((shared.version(), shared.moving()), (version, true));
        let grab = Action::Grab(ObjectId(1));
        shared.lead(&grab, Some(Transform::default()), shared.clock().now());
        // The server has been started again, and its clock with it.
        shared.new_broadcast();
        assert!(!shared.moving() && shared.advance(shared.clock().now()).is_empty(), "nothing of before is led or on its way");
        shared.apply(&at(3.0, 1_000)).unwrap();
        assert_eq!((shared.version(), shared.moving()), (version + 1, false));
        // What moves now does so by the new clock: it is on its way, and not there at once.
        shared.apply(&at(4.0, 17_667)).unwrap();
        let moved = shared.advance(shared.clock().now());
        assert!(matches!(moved[..], [(ObjectId(1), to)] if to.position.x < 4.0), "{moved:?}");
    }
}
