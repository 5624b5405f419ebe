//! Where wishes go: to the server, and into the script that is recorded.

use std::sync::{Arc, Mutex, PoisonError};

use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::{Action, Motion, PUT_BURST, PUT_INTERVAL_US, Rate};

use super::shared_scene::SharedScene;
use crate::script::{self, Deed};

/// Most objects that are put and removed at once; half of what the server takes is left for what comes to it in a heap.
const BURST: u32 = PUT_BURST / 2;

/// What hands wishes on to `send`. Nothing is put that the server would refuse as too much at once, and what may not be removed is let go of
/// instead: whoever wished that no longer holds it.
pub(super) fn wishes(
    send: impl Fn(Action) + Clone + Send + 'static,
    recorder: Option<script::Recorder>,
    scene: SharedScene,
    now: impl Fn() -> ClientTime + Clone + Send + 'static,
) -> impl FnMut(Action) + Clone + Send + 'static {
    let recorder = recorder.map(|recorder| Arc::new(Mutex::new(recorder)));
    let rate = Arc::new(Mutex::new(Rate::default()));
    move |wish: Action| {
        let Some(action) = within_rate(wish, &rate, &scene, now()) else { return };
        if let Some(recorder) = &recorder {
            // The time is read under the lock: those of a script never go back.
            let mut recorder = recorder.lock().unwrap_or_else(PoisonError::into_inner);
            recorder.write(&Deed::Action(now(), action.clone()));
        }
        send(action);
    }
}

/// What becomes of a wish.
fn within_rate(wish: Action, rate: &Mutex<Rate>, scene: &SharedScene, now: ClientTime) -> Option<Action> {
    let counts = matches!(wish, Action::Put { .. } | Action::Remove(_));
    if !counts || rate.lock().unwrap_or_else(PoisonError::into_inner).take(now.0, BURST) {
        return Some(wish);
    }
    tracing::warn!(
        action = ?wish,
        "not done: only {BURST} objects are put or removed at once and one more every {} ms; wait a moment",
        PUT_INTERVAL_US / 1_000
    );
    let Action::Remove(object) = wish else { return None };
    let release = Action::Release(object, Motion::STILL);
    // So it is shown, too: a removal alone changes nothing before the server answers it.
    scene.lead(&release, None, now);
    Some(release)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use glam::Vec3;
    use mr360_protocol::scene::{Geometry, Object, ObjectId, Scene, SceneMessage, Shape, Transform};

    use super::*;
    use crate::sync::ClientClock;

    const BALL: ObjectId = ObjectId(1);
    const BEGIN: ClientTime = ClientTime(0);

    fn scene() -> SharedScene {
        let geometry = Geometry::Shape(Shape::Sphere);
        let ball = Object { id: BALL, geometry, transform: Transform::default(), material: None, animation: Default::default() };
        let shared = SharedScene::new(ClientClock::start());
        shared.apply(&SceneMessage::Snapshot { at_us: 0, scene: Scene { objects: vec![ball], ..Scene::default() } }).unwrap();
        shared
    }

    #[test]
    fn what_may_not_be_removed_is_let_go_of_and_what_may_not_be_put_is_not() {
        let scene = scene();
        let (sent, wished) = channel();
        let mut act = wishes(move |action| sent.send(action).unwrap(), None, scene.clone(), || BEGIN);
        let put = Action::Put { item: 0, transform: Transform::default() };
        (0..BURST).for_each(|_| act(put.clone()));
        assert_eq!(wished.try_iter().collect::<Vec<_>>(), vec![put.clone(); BURST as usize]);

        let moved = Transform { position: Vec3::X * 5.0, ..Transform::default() };
        for action in [Action::Grab(BALL), Action::Move(BALL, moved), Action::Remove(BALL)] {
            scene.lead(&action, Some(Transform::default()), BEGIN);
            if matches!(action, Action::Remove(_)) {
                act(put.clone());
            }
            act(action);
        }
        let let_go = [Action::Grab(BALL), Action::Move(BALL, moved), Action::Release(BALL, Motion::STILL)];
        assert_eq!(wished.try_iter().collect::<Vec<_>>(), let_go);
        // Nobody leads it: in the end it is shown where the scene has it.
        assert_eq!(scene.advance(BEGIN), [(BALL, moved)]);
        let shown = [1, 3, 4].map(|seconds| scene.advance(ClientTime(seconds * 1_000_000)));
        assert!(shown[2].is_empty(), "{shown:?}");
    }

    #[test]
    fn with_time_more_may_be_removed() {
        let at = Arc::new(Mutex::new(BEGIN));
        let (sent, wished) = channel();
        let clock = Arc::clone(&at);
        let mut act = wishes(move |action| sent.send(action).unwrap(), None, scene(), move || *clock.lock().unwrap());
        (0..BURST).for_each(|_| act(Action::Remove(BALL)));
        assert_eq!(wished.try_iter().collect::<Vec<_>>(), vec![Action::Remove(BALL); BURST as usize]);
        act(Action::Remove(BALL));
        *at.lock().unwrap() = ClientTime(PUT_INTERVAL_US);
        act(Action::Remove(BALL));
        assert_eq!(wished.try_iter().collect::<Vec<_>>(), [Action::Release(BALL, Motion::STILL), Action::Remove(BALL)]);
    }
}
