//! Who may do what, and what becomes of it.

use super::known::REMEMBERED;
use super::users::{Event, follow_users};
use super::*;
use glam::Vec3;
use mr360_protocol::codec::Message;
use mr360_protocol::scene::{Geometry, Shape};
use mr360_protocol::track;

/// Cubes a metre wide that hang in the air on a grid, too far apart to touch each other.
fn cubes(count: u32) -> Session {
    let object = |id: u32| Object {
        id: ObjectId(id),
        geometry: Geometry::Shape(Shape::Cube),
        transform: Transform { position: Vec3::new((id / 32) as f32 * 10.0, 2.0, (id % 32) as f32 * -10.0), ..Transform::default() },
        material: None,
        animation: Default::default(),
    };
    let scene = Scene { objects: (1..=count).map(object).collect(), ..Scene::default() };
    Session::new(Opening { scene, ..Opening::default() })
}

fn session() -> Session {
    cubes(2)
}

fn wish(session: &mut Session, user: &str, sequence: u64, action: Action) -> Result<(), Refusal> {
    session.intent(user, &Intent { sequence, action })
}

fn to(x: f32) -> Transform {
    Transform { position: Vec3::X * x, ..Transform::default() }
}

#[test]
fn the_last_place_of_each_object_is_published() {
    let mut session = session();
    for (sequence, x) in [(1, 1.0), (2, 2.0), (3, 3.0)] {
        session.intent("ann", &Intent { sequence, action: Action::Move(ObjectId(1), to(x)) }).unwrap();
    }
    session.intent("bob", &Intent { sequence: 1, action: Action::Move(ObjectId(2), to(9.0)) }).unwrap();
    assert_eq!(session.tick(), Some(vec![Change::Move(ObjectId(1), to(3.0)), Change::Move(ObjectId(2), to(9.0))]));
    assert_eq!(session.tick(), None);
    assert_eq!((session.scene().revision, session.scene().objects[0].transform), (1, to(3.0)));
}

#[test]
fn a_held_object_follows_its_holder_alone() {
    let mut session = session();
    session.intent("ann", &Intent { sequence: 1, action: Action::Grab(ObjectId(1)) }).unwrap();
    let steal = Intent { sequence: 1, action: Action::Move(ObjectId(1), to(5.0)) };
    assert_eq!(session.intent("bob", &steal), Err(Refusal::Held { object: ObjectId(1), holder: "ann".to_owned() }));
    session.leave("ann", Instant::now());
    session.intent("bob", &steal).unwrap();
    assert_eq!(session.tick(), Some(vec![Change::Move(ObjectId(1), to(5.0))]));
}

#[test]
fn late_and_unknown_intents_change_nothing() {
    let mut session = session();
    session.intent("ann", &Intent { sequence: 5, action: Action::Move(ObjectId(1), to(1.0)) }).unwrap();
    assert_eq!(session.intent("ann", &Intent { sequence: 5, action: Action::Release(ObjectId(1), Motion::STILL) }), Err(Refusal::Stale));
    let unknown = Intent { sequence: 6, action: Action::Grab(ObjectId(7)) };
    assert_eq!(session.intent("ann", &unknown), Err(Refusal::NoSuchObject(ObjectId(7))));
}

#[test]
fn what_is_delivered_again_after_a_reconnect_is_old() {
    let mut session = session();
    let now = Instant::now();
    let drag = Intent { sequence: 7, action: Action::Move(ObjectId(1), to(1.0)) };
    session.intent("ann", &drag).unwrap();
    session.leave("ann", now);
    assert_eq!(session.intent("ann", &drag), Err(Refusal::Stale));
    session.intent("ann", &Intent { sequence: 8, action: Action::Release(ObjectId(1), Motion::STILL) }).unwrap();
    session.leave("ann", now);
    session.leave("bob", now + REMEMBERED);
    assert!(session.users.is_empty(), "users who left are not remembered for ever");
}

#[test]
fn what_is_let_go_of_falls_for_everyone_until_it_rests() {
    let mut session = session();
    let cube = ObjectId(1);
    wish(&mut session, "ann", 1, Action::Grab(cube)).unwrap();
    wish(&mut session, "ann", 2, Action::Release(cube, Motion { linear: Vec3::X, angular: Vec3::ZERO })).unwrap();
    let mut heights = Vec::new();
    let mut ticks = 0;
    while !session.at_rest() {
        ticks += 1;
        assert!(ticks < 600, "it never rests");
        let Some(changes) = session.tick() else { continue };
        let [Change::Move(id, transform)] = changes[..] else { panic!("{changes:?}") };
        assert_eq!((id, transform), (cube, session.scene().objects[0].transform));
        heights.push(transform.position.y);
    }
    let ground = session.scene().ground_y;
    assert!(heights.len() > 30 && heights[..10].is_sorted_by(|a, b| a > b), "{heights:?}");
    assert!((heights.last().unwrap() - (ground + 0.5)).abs() < 0.01, "{heights:?}");
    assert_eq!(session.scene().revision, heights.len() as u64, "a delta without a change");
}

#[test]
fn who_leaves_lets_go() {
    let mut session = session();
    wish(&mut session, "ann", 1, Action::Move(ObjectId(1), to(1.0))).unwrap();
    session.tick();
    assert_eq!(session.tick(), None, "what is held does not fall");
    session.leave("ann", Instant::now());
    (0..10).for_each(|_| drop(session.tick()));
    let there = session.scene().objects[0].transform.position;
    assert!(there.y < -0.05, "{there}");
}

#[test]
fn items_of_the_library_are_put_and_objects_removed() {
    let mut session = session();
    let put = |x| Action::Put { item: 1, transform: to(x) };
    wish(&mut session, "ann", 1, put(5.0)).unwrap();
    wish(&mut session, "ann", 2, put(8.0)).unwrap();
    let changes = session.tick().unwrap();
    let [Change::Put(first), Change::Put(second)] = &changes[..] else { panic!("{changes:?}") };
    let item = &session.scene().library[1];
    assert_eq!((first.id, second.id), (ObjectId(3), ObjectId(4)));
    assert_eq!((first.geometry, first.material), (item.geometry, item.material));
    // It falls at once.
    (0..60).for_each(|_| drop(session.tick()));
    assert!(session.scene().objects[2].transform.position.y < -0.5);

    // Nobody takes away what another holds, nor what is gone.
    wish(&mut session, "bob", 1, Action::Grab(ObjectId(3))).unwrap();
    assert_eq!(
        wish(&mut session, "ann", 3, Action::Remove(ObjectId(3))),
        Err(Refusal::Held { object: ObjectId(3), holder: "bob".to_owned() })
    );
    wish(&mut session, "bob", 2, Action::Remove(ObjectId(3))).unwrap();
    assert_eq!(wish(&mut session, "bob", 3, Action::Grab(ObjectId(3))), Err(Refusal::NoSuchObject(ObjectId(3))));
    assert!(session.tick().unwrap().contains(&Change::Remove(ObjectId(3))));
    assert_eq!(session.scene().objects.iter().map(|o| o.id.0).collect::<Vec<_>>(), [1, 2, 4]);

    // What came and went between two ticks is nobody's business, and its name is not given again.
    wish(&mut session, "ann", 4, put(5.0)).unwrap();
    wish(&mut session, "ann", 5, Action::Remove(ObjectId(5))).unwrap();
    wish(&mut session, "ann", 6, put(5.0)).unwrap();
    let changes = session.tick().unwrap();
    assert!(!changes.iter().any(|change| matches!(change, Change::Remove(_))), "{changes:?}");
    assert_eq!(session.scene().objects.iter().map(|o| o.id.0).collect::<Vec<_>>(), [1, 2, 4, 6]);

    assert_eq!(wish(&mut session, "ann", 7, Action::Put { item: 4, transform: to(0.0) }), Err(Refusal::NoSuchItem(4)));
    fill(&mut session);
    assert_eq!(wish(&mut session, "ann", 9999, put(0.0)), Err(Refusal::Full));
    // A refusal takes no number: the same wish may come again.
    wish(&mut session, "ann", 9998, Action::Remove(ObjectId(1))).unwrap();
    wish(&mut session, "ann", 9999, put(0.0)).unwrap();
}

/// Puts until nothing more has room, by many users.
fn fill(session: &mut Session) {
    for i in 0..(MAX_OBJECTS - session.objects.len()) as u64 {
        let user = format!("user{}", i / u64::from(PUT_BURST));
        wish(session, &user, 1 + i, Action::Put { item: 1, transform: to(2.0 * i as f32 - 900.0) }).unwrap();
    }
}

/// All that was changed is known to viewers.
fn publish_all(session: &mut Session) {
    while !session.unpublished.is_empty() {
        session.tick();
    }
}

fn is_published(session: &Session) -> bool {
    session.scene.objects.iter().eq(session.objects.values())
}

#[test]
fn a_full_scene_takes_what_is_put_for_what_is_removed() {
    let mut session = session();
    fill(&mut session);
    publish_all(&mut session);
    for round in 0..3u32 {
        // So that what is put would have its turn first.
        session.published = ObjectId(500);
        wish(&mut session, "ann", 10 + u64::from(round), Action::Remove(ObjectId(5 + round))).unwrap();
        wish(&mut session, "ann", 20 + u64::from(round), Action::Put { item: 1, transform: to(950.0) }).unwrap();
        let changes = session.tick().unwrap();
        assert_eq!(changes[0], Change::Remove(ObjectId(5 + round)));
        assert!(changes.iter().any(|change| matches!(change, Change::Put(put) if put.id == ObjectId(1025 + round))), "{changes:?}");
        assert!(session.scene.object(ObjectId(5 + round)).is_none() && session.scene.objects.len() == MAX_OBJECTS);
    }
    while !session.at_rest() {
        session.tick();
    }
    assert!(is_published(&session));
}

#[test]
fn changes_that_do_not_fit_are_gathered_anew() {
    let mut session = session();
    wish(&mut session, "ann", 1, Action::Move(ObjectId(1), to(1.0))).unwrap();
    wish(&mut session, "ann", 2, Action::Put { item: 1, transform: to(5.0) }).unwrap();
    wish(&mut session, "ann", 3, Action::Remove(ObjectId(2))).unwrap();
    session.unpublished.insert(ObjectId(77), Unpublished::Removed);
    assert_eq!(session.tick(), None);
    let changes = session.tick().unwrap();
    assert!(changes.contains(&Change::Remove(ObjectId(2))) && changes.contains(&Change::Move(ObjectId(1), to(1.0))), "{changes:?}");
    assert!(is_published(&session));
}

#[test]
fn a_user_holds_puts_and_removes_a_few_objects_and_leaves_others_theirs() {
    let mut session = cubes(100);
    for id in 1..=MAX_HELD as u32 {
        wish(&mut session, "ann", id.into(), Action::Grab(ObjectId(id))).unwrap();
    }
    assert_eq!(wish(&mut session, "ann", 50, Action::Grab(ObjectId(50))), Err(Refusal::TooManyHeld));
    assert_eq!(wish(&mut session, "ann", 50, Action::Move(ObjectId(50), to(1.0))), Err(Refusal::TooManyHeld));
    wish(&mut session, "ann", 51, Action::Move(ObjectId(1), to(1.0))).unwrap();
    wish(&mut session, "bob", 1, Action::Grab(ObjectId(50))).unwrap();
    wish(&mut session, "ann", 52, Action::Release(ObjectId(1), Motion::STILL)).unwrap();
    wish(&mut session, "ann", 53, Action::Grab(ObjectId(51))).unwrap();

    // At once so many, then at a pace, and in all an eighth of a scene.
    let put = Action::Put { item: 1, transform: to(500.0) };
    let mut sequence = 100;
    let mut puts = |session: &mut Session, ticks: u32| {
        (0..ticks).for_each(|_| drop(session.tick()));
        let granted = std::iter::from_fn(|| {
            sequence += 1;
            Some(wish(session, "ann", sequence, put.clone()))
        });
        let mut granted = granted.take_while(Result::is_ok).count();
        if granted == 0 {
            granted = usize::MAX;
        }
        granted
    };
    assert_eq!(puts(&mut session, 0), PUT_BURST as usize);
    assert_eq!(puts(&mut session, 16), 1);
    assert_eq!(wish(&mut session, "ann", 1_000, Action::Remove(ObjectId(60))), Err(Refusal::TooFast));
    wish(&mut session, "bob", 2, Action::Remove(ObjectId(60))).unwrap();
    while puts(&mut session, 600) != usize::MAX {}
    assert_eq!(session.put_by.len(), MAX_PUT);
    assert_eq!(wish(&mut session, "ann", 2_000, put.clone()), Err(Refusal::TooManyPut));
    wish(&mut session, "bob", 3, put.clone()).unwrap();
    let own = *session.put_by.iter().find(|(_, by)| *by == "ann").unwrap().0;
    wish(&mut session, "ann", 2_001, Action::Remove(own)).unwrap();
    wish(&mut session, "ann", 2_002, put).unwrap();
}

#[test]
fn drags_that_overtake_each_other_all_count_and_none_twice() {
    let mut session = session();
    let put = Action::Put { item: 1, transform: to(5.0) };
    let [first, second] = [ObjectId(1), ObjectId(2)];
    wish(&mut session, "ann", 1, Action::Grab(first)).unwrap();
    // The group of the next drag, and what was put after it, come before the end of the first.
    wish(&mut session, "ann", 6, put.clone()).unwrap();
    wish(&mut session, "ann", 4, Action::Grab(second)).unwrap();
    wish(&mut session, "ann", 5, Action::Release(second, Motion::STILL)).unwrap();
    wish(&mut session, "ann", 3, Action::Release(first, Motion::STILL)).unwrap();
    assert!(session.holders.is_empty(), "a release that came late holds nothing");
    wish(&mut session, "ann", 2, put.clone()).unwrap();
    assert_eq!(session.objects.len(), 4);
    for (sequence, old) in [(6, put.clone()), (2, put.clone()), (3, Action::Grab(first)), (4, Action::Release(second, Motion::STILL))] {
        assert_eq!(wish(&mut session, "ann", sequence, old), Err(Refusal::Stale));
    }
    // What is older than all that can be told apart is old.
    for sequence in 10..200 {
        session.users.granted("ann", &Intent { sequence, action: put.clone() });
    }
    assert_eq!(wish(&mut session, "ann", 7, put), Err(Refusal::Stale));
}

#[test]
fn what_nobody_says_to_be_held_any_more_is_let_go_of() {
    let mut session = session();
    let ticks = HOLD_LOST_US / STEP_US;
    wish(&mut session, "ann", 1, Action::Grab(ObjectId(1))).unwrap();
    (0..ticks - 1).for_each(|_| drop(session.tick()));
    wish(&mut session, "ann", 2, Action::Grab(ObjectId(1))).unwrap();
    (0..ticks).for_each(|_| drop(session.tick()));
    assert!(session.holders.contains_key(&ObjectId(1)), "it was said again");
    (0..2).for_each(|_| drop(session.tick()));
    assert!(session.holders.is_empty());
    (0..10).for_each(|_| drop(session.tick()));
    assert!(session.scene().objects[0].transform.position.y < 2.0, "it falls");
}

#[test]
fn where_more_moves_than_a_delta_holds_all_have_their_turn() {
    let mut session = cubes(2 * MAX_CHANGES as u32 + 10);
    let user = |id: u64| format!("user{}", id / MAX_HELD as u64);
    let mut seen = BTreeSet::new();
    for turn in 0..3u64 {
        for id in 1..=2 * MAX_CHANGES as u64 + 10 {
            let up = Transform { position: Vec3::new(0.0, turn as f32, -(id as f32)), ..Transform::default() };
            wish(&mut session, &user(id), 1 + turn, Action::Move(ObjectId(id as u32), up)).unwrap();
        }
        let changes = session.tick().unwrap();
        assert_eq!(changes.len(), MAX_CHANGES);
        seen.extend(changes.iter().map(|change| match change {
            Change::Move(id, _) => *id,
            other => panic!("{other:?}"),
        }));
    }
    assert_eq!(seen.len(), 2 * MAX_CHANGES + 10, "some never had their turn");
}

/// A user's broadcast with one intent on it.
fn publish(origin: &moq_net::origin::Producer, sequence: u64, x: f32) -> (moq_net::broadcast::Producer, moq_net::track::Producer) {
    let broadcast = origin.create_broadcast(track::user_path("live", "bob")).unwrap();
    let mut intents = broadcast.create_track(track::INTENT, track::scene_info()).unwrap();
    broadcast.announce(moq_net::origin::Route::default()).unwrap();
    let intent = Intent { sequence, action: Action::Move(ObjectId(1), to(x)) };
    intents.write_frame(moq_net::Timestamp::now(), intent.to_wire().unwrap()).unwrap();
    (broadcast, intents)
}

async fn sequence(events: &mut mpsc::Receiver<Event>) -> u64 {
    loop {
        match events.recv().await.unwrap() {
            Event::Intent(_, intent) => return intent.sequence,
            Event::Left(_) => {}
        }
    }
}

#[tokio::test]
async fn a_user_is_heard_after_an_overlapping_reconnect() {
    let origin = mr360_protocol::transport::origin();
    let (sender, mut events) = mpsc::channel(16);
    let following = tokio::spawn(follow_users(origin.consume(), "live".to_owned(), sender));
    let first = publish(&origin, 1, 1.0);
    assert_eq!(sequence(&mut events).await, 1);
    let second = publish(&origin, 2, 2.0);
    drop(first);
    assert_eq!(sequence(&mut events).await, 2);
    drop(second);
    while !matches!(events.recv().await.unwrap(), Event::Left(user) if user == "bob") {}
    following.abort();
}
