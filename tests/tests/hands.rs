//! Grab, stack and throw, recorded and played again: through hands and session alone, and by real viewers of a real server.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use glam::{Quat, Vec3};
use mr360_client::hands::{HandInput, Hands, HandsInput, Pose, World};
use mr360_client::scene::mesh::Bounds;
use mr360_client::scene::pick::{Ray, Target, nearest, nearest_to};
use mr360_client::script::{self, Deed, Recorder};
use mr360_protocol::clock::ClientTime;
use mr360_protocol::intent::{Action, Intent, Motion};
use mr360_protocol::scene::{Geometry, LibraryItem, Object, ObjectId, Scene, Shape, Transform};
use mr360_server::session::{Opening, Session};
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::sandbox::Sandbox;

const GROUND_Y: f32 = -1.6;
const FOOT: ObjectId = ObjectId(1);
const CUBE: ObjectId = ObjectId(2);
const BALL: ObjectId = ObjectId(3);
/// What Bob puts.
const PUT: ObjectId = ObjectId(4);
const TAKEN_AWAY: ObjectId = ObjectId(5);
/// Of the cubes' sides and the ball's diameter, metres.
const SIZE_M: f32 = 0.3;
const FRAME_US: u64 = 11_111;
const TICK_US: u64 = 16_667;

/// As `scene()` says.
const SCENE: &str = r#"
ground_y = -1.6
[[object]]
shape = "cube"
position = [0.0, -1.45, -2.0]
scale = 0.3
[[object]]
shape = "cube"
position = [0.8, -0.5, -1.5]
scale = 0.3
[[object]]
shape = "sphere"
position = [-0.6, -0.2, -0.6]
scale = 0.3
"#;

fn scene() -> Scene {
    let object = |id, shape, position| Object {
        id,
        geometry: Geometry::Shape(shape),
        transform: Transform { position, scale: Vec3::splat(SIZE_M), ..Transform::default() },
        material: None,
        animation: Default::default(),
    };
    let objects = vec![
        object(FOOT, Shape::Cube, Vec3::new(0.0, -1.45, -2.0)),
        object(CUBE, Shape::Cube, Vec3::new(0.8, -0.5, -1.5)),
        object(BALL, Shape::Sphere, Vec3::new(-0.6, -0.2, -0.6)),
    ];
    Scene { ground_y: GROUND_Y, objects, ..Scene::default() }
}

/// A session as its users see it, without a network.
struct Room {
    session: Session,
    sequence: u64,
    /// Next tick.
    tick_us: u64,
}

const BOX: Bounds = Bounds { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };

impl Room {
    fn new() -> Self {
        Self { session: Session::new(Opening { scene: scene(), ..Opening::default() }), sequence: 0, tick_us: 0 }
    }

    fn targets(&self) -> impl Iterator<Item = Target> + '_ {
        self.session.scene().objects.iter().map(|object| Target {
            id: object.id,
            transform: object.transform,
            bounds: BOX,
            shape: if let Geometry::Shape(shape) = object.geometry { Some(shape) } else { None },
        })
    }

    fn wish(&mut self, user: &str, action: Action) -> Result<()> {
        self.sequence += 1;
        Ok(self.session.intent(user, &Intent { sequence: self.sequence, action })?)
    }

    fn until(&mut self, now: ClientTime) {
        while self.tick_us <= now.0 {
            self.session.tick();
            self.tick_us += TICK_US;
        }
    }

    /// Lets everything come to rest.
    fn settle(&mut self) -> Result<Scene> {
        for _ in 0..2_000 {
            if self.session.at_rest() {
                return Ok(self.session.scene().clone());
            }
            self.session.tick();
        }
        anyhow::bail!("nothing comes to rest")
    }
}

impl World for Room {
    fn pick(&self, ray: &Ray) -> Option<(ObjectId, Vec3)> {
        nearest(ray, self.targets())
    }
    fn near(&self, point: Vec3, reach_m: f32) -> Option<ObjectId> {
        Some(nearest_to(point, reach_m, self.targets())?.0)
    }
    fn transform(&self, object: ObjectId) -> Option<Transform> {
        Some(self.session.scene().object(object)?.transform)
    }
    fn object_bounds(&self, _object: ObjectId) -> Option<Bounds> {
        Some(BOX)
    }
    fn bounds(&self, _geometry: &Geometry) -> Option<Bounds> {
        Some(BOX)
    }
    fn library(&self) -> &[LibraryItem] {
        &self.session.scene().library
    }
    fn ground_y(&self) -> f32 {
        GROUND_Y
    }
}

/// The way of a hand between points that it passes at these times, seconds, at an even speed; it squeezes while it holds.
struct Way(&'static [(f32, Vec3, bool)]);

impl Way {
    fn at(&self, seconds: f32) -> HandInput {
        let next = self.0.iter().position(|(at, ..)| *at > seconds).unwrap_or(self.0.len());
        let (begin, from, holds) = self.0[next.saturating_sub(1)];
        let (end, to, _) = self.0[next.min(self.0.len() - 1)];
        let t = if end > begin { ((seconds - begin) / (end - begin)).clamp(0.0, 1.0) } else { 0.0 };
        let pose = Pose { position: from.lerp(to, t), orientation: Quat::IDENTITY };
        HandInput { grip: Some(pose), aim: Some(pose), squeeze: f32::from(u8::from(holds)), ..HandInput::default() }
    }
}

/// The right hand brings the cube to the foot and sets it down there; the left one takes the ball and throws it.
const STACKS: Way = Way(&[
    (0.0, Vec3::new(0.8, -0.5, -1.3), false),
    (0.2, Vec3::new(0.8, -0.5, -1.4), true),
    (1.2, Vec3::new(0.0, -0.9, -1.9), true),
    (1.7, Vec3::new(0.0, -1.145, -1.9), true),
    (2.2, Vec3::new(0.0, -1.145, -1.9), false),
    (2.6, Vec3::new(0.3, -0.3, -0.3), false),
]);
const THROWS: Way = Way(&[
    (0.0, Vec3::new(-0.6, -0.2, -0.4), false),
    (0.4, Vec3::new(-0.6, -0.2, -0.5), true),
    (1.0, Vec3::new(-0.6, -0.4, 0.0), true),
    (1.2, Vec3::new(-0.6, 0.0, -0.8), false),
    (1.6, Vec3::new(-0.6, 0.0, -0.9), false),
]);
const SECONDS: f32 = 2.7;

fn frames() -> impl Iterator<Item = HandsInput> {
    let frames = (SECONDS * 1e6) as u64 / FRAME_US;
    (0..frames).map(|frame| {
        let now = ClientTime(frame * FRAME_US);
        let seconds = now.0 as f32 * 1e-6;
        HandsInput { hands: [THROWS.at(seconds), STACKS.at(seconds)], head: Pose::IDENTITY, now, scale: 1.0 }
    })
}

/// Hands in a room of their own, and where all ends.
fn act_out(inputs: impl Iterator<Item = HandsInput>) -> Result<(Scene, Vec<Action>)> {
    let (mut room, mut hands, mut wished) = (Room::new(), Hands::default(), Vec::new());
    for input in inputs {
        room.until(input.now);
        for action in hands.update(&input, &room).actions {
            wished.push(action.clone());
            room.wish("ann", action)?;
        }
    }
    Ok((room.settle()?, wished))
}

fn bits(scene: &Scene) -> Vec<u32> {
    let numbers =
        |t: &Transform| t.position.to_array().into_iter().chain(t.rotation.to_array()).chain(t.scale.to_array()).collect::<Vec<_>>();
    scene.objects.iter().flat_map(|object| numbers(&object.transform)).map(f32::to_bits).collect()
}

fn at(scene: &Scene, id: ObjectId) -> Result<Vec3> {
    Ok(scene.object(id).context("an object is gone")?.transform.position)
}

/// The cube stands on the foot, and the ball has flown.
fn is_stacked_and_thrown(scene: &Scene) -> Result<()> {
    let (foot, cube, ball) = (at(scene, FOOT)?, at(scene, CUBE)?, at(scene, BALL)?);
    ensure!((foot.y - (GROUND_Y + 0.5 * SIZE_M)).abs() < 0.01, "the foot is at {foot}");
    ensure!((cube - foot - Vec3::Y * SIZE_M).length() < 0.03, "the cube is at {cube}, the foot at {foot}");
    ensure!(ball.z < -2.0 && (ball.y - (GROUND_Y + 0.5 * SIZE_M)).abs() < 0.01, "the ball is at {ball}");
    Ok(())
}

#[test]
fn hands_that_are_recorded_and_played_again_end_in_the_same_bits() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("hands.jsonl");
    let mut recorder = Recorder::create(&path)?;
    let (lived, wished) = act_out(frames().inspect(|input| recorder.write(&Deed::Hands(*input))))?;
    drop(recorder);
    is_stacked_and_thrown(&lived)?;
    let thrown = wished.iter().find_map(|action| match action {
        Action::Release(BALL, motion) => Some(*motion),
        _ => None,
    });
    let motion = thrown.context("the ball was not let go of")?;
    ensure!(motion.linear.distance(Vec3::new(0.0, 2.0, -4.0)) < 0.3, "thrown with {motion:?}");

    let inputs = script::load(&path)?.into_iter().map(|deed| match deed {
        Deed::Hands(input) => Ok(input),
        other @ Deed::Action(..) => anyhow::bail!("{other:?} was not recorded"),
    });
    let (played, _) = act_out(inputs.collect::<Result<Vec<_>>>()?.into_iter())?;
    ensure!(bits(&played) == bits(&lived), "{played:?}\nis not\n{lived:?}");
    Ok(())
}

/// Wishes of several users, each with its time, and where all ends.
fn carry_out(scripts: &[(&str, Vec<Deed>)]) -> Result<Scene> {
    let mut room = Room::new();
    let mut all: Vec<_> = scripts.iter().flat_map(|(user, deeds)| deeds.iter().map(move |deed| (deed.at(), *user, deed))).collect();
    all.sort_by_key(|(at, user, _)| (*at, *user));
    for (at, user, deed) in all {
        room.until(at);
        if let Deed::Action(_, action) = deed {
            room.wish(user, action.clone())?;
        }
    }
    room.settle()
}

/// Ann stacks, and meanwhile Bob throws the ball, puts two things from the library, and takes one of them away again.
fn scripts() -> [(&'static str, Vec<Deed>); 2] {
    let to = |position| Transform { position, scale: Vec3::splat(SIZE_M), ..Transform::default() };
    let lead = |object, from: Vec3, to_: Vec3, begin: u64, frames: u64| {
        (0..=frames).map(move |frame| {
            let position = from.lerp(to_, frame as f32 / frames as f32);
            Deed::Action(ClientTime(begin + frame * FRAME_US), Action::Move(object, to(position)))
        })
    };
    let (high, above) = (Vec3::new(0.02, -0.8, -2.0), Vec3::new(0.02, -1.145, -2.0));
    let mut ann = vec![Deed::Action(ClientTime(0), Action::Grab(CUBE))];
    ann.extend(lead(CUBE, Vec3::new(0.8, -0.5, -1.5), high, FRAME_US, 60));
    ann.extend(lead(CUBE, high, above, 70 * FRAME_US, 40));
    ann.push(Deed::Action(ClientTime(1_300_000), Action::Release(CUBE, Motion::STILL)));
    let mut bob = vec![Deed::Action(ClientTime(200_000), Action::Grab(BALL))];
    bob.extend(lead(BALL, Vec3::new(-0.6, -0.2, -0.6), Vec3::new(-0.6, 0.2, -1.4), 220_000, 18));
    let motion = Motion { linear: Vec3::new(0.0, 2.0, -4.0), angular: Vec3::new(-3.0, 0.0, 0.0) };
    bob.push(Deed::Action(ClientTime(430_000), Action::Release(BALL, motion)));
    for (at, x) in [(600_000, 3.0), (700_000, 5.0)] {
        let transform = Transform { position: Vec3::new(x, -0.6, -3.0), rotation: Quat::from_rotation_x(0.4), scale: Vec3::splat(SIZE_M) };
        bob.push(Deed::Action(ClientTime(at), Action::Put { item: 1, transform }));
    }
    bob.push(Deed::Action(ClientTime(1_400_000), Action::Remove(TAKEN_AWAY)));
    [("ann", ann), ("bob", bob)]
}

fn write(path: &Path, deeds: &[Deed]) -> Result<()> {
    let mut recorder = Recorder::create(path)?;
    // Times begin with the first deed: everybody's do with the same.
    recorder.write(&Deed::Action(ClientTime(0), Action::Release(ObjectId(999), Motion::STILL)));
    deeds.iter().for_each(|deed| recorder.write(deed));
    Ok(())
}

/// Where the network's timing changes what a held cube pushes as it is set down, metres.
const SAME_M: f32 = 2e-3;

/// The ball, which touched nothing while it was held, and what was put are there to the last bit, the cubes nearly, and nothing else is.
fn is_same(scene: &Scene, expected: &Scene) -> bool {
    let both = |id| scene.object(id).zip(expected.object(id)).map(|(a, b)| (a.transform, b.transform));
    let near = |id| both(id).is_some_and(|(a, b)| a.position.distance(b.position) < SAME_M);
    let same = |id| both(id).is_some_and(|(a, b)| a == b);
    let ids = |scene: &Scene| scene.objects.iter().map(|object| object.id).collect::<Vec<_>>();
    ids(scene) == ids(expected) && same(BALL) && (same(PUT) || expected.object(PUT).is_none()) && near(FOOT) && near(CUBE)
}

/// Waits until the server's scene is this one.
fn ends_as(witness: &Probe, expected: &Scene) -> Result<()> {
    let mut scene = Scene::default();
    let reached = witness.scene("all has come to rest where it should", |message| {
        // A delta of before the first snapshot does not fit, and does not matter.
        let fits = scene.apply(message).is_ok();
        (fits && is_same(&scene, expected)).then_some(())
    });
    reached.with_context(|| format!("it ended as {scene:?}\nnot as {expected:?}"))
}

/// Plays scripts by real viewers of a real server until all is as expected.
fn play(scripts: &[(&str, &Path)], expected: &Scene) -> Result<()> {
    let sandbox = Sandbox::new()?;
    std::fs::write(sandbox.path("scene.toml"), SCENE)?;
    let source = "synthetic:testcard?size=128x64&fps=10";
    let mut server = sandbox.serve(source, &["--listen", "127.0.0.1:0", "--scene", "scene.toml"])?;
    let witness = Probe::join(&server.join_url)?;
    let mut viewers = Vec::new();
    for (user, script) in scripts {
        let script = script.to_str().context("the temporary folder's path is not Unicode")?;
        let arguments = ["--mode", "headless", "--size", "32x18", "--mute", "--user", user, "--replay-input", script];
        viewers.push(sandbox.join(user, &server.join_url, &arguments)?);
    }
    let end = ends_as(&witness, expected);
    for viewer in &mut viewers {
        viewer.kill()?;
        ensure!(!viewer.output().contains("panicked"), "{}", viewer.output());
    }
    server.program.finish(LONG)?;
    ensure!(!server.program.output().contains("panicked"), "{}", server.program.output());
    end
}

#[test]
fn wishes_of_two_viewers_end_where_the_session_alone_ends() -> Result<()> {
    let scripts = scripts();
    let expected = carry_out(&scripts)?;
    is_stacked_and_thrown(&expected)?;
    ensure!(expected.object(PUT).is_some() && expected.object(TAKEN_AWAY).is_none(), "{expected:?}");
    ensure!(bits(&carry_out(&scripts)?) == bits(&expected), "the same wishes end elsewhere");
    let folder = tempfile::tempdir()?;
    let paths: Vec<_> = scripts.iter().map(|(user, _)| folder.path().join(format!("{user}.jsonl"))).collect();
    for ((_, deeds), path) in scripts.iter().zip(&paths) {
        write(path, deeds)?;
    }
    play(&[("ann", &paths[0]), ("bob", &paths[1])], &expected)
}

#[test]
fn recorded_hands_of_a_real_viewer_end_where_they_ended_without_a_network() -> Result<()> {
    let (expected, _) = act_out(frames())?;
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("hands.jsonl");
    let mut recorder = Recorder::create(&path)?;
    frames().for_each(|input| recorder.write(&Deed::Hands(input)));
    drop(recorder);
    play(&[("ann", &path)], &expected)
}
