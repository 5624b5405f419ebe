//! Peers that lie: a server of random bytes, and a viewer of random wishes.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use glam::Vec3;
use mr360_protocol::asset::AssetId;
use mr360_protocol::codec::Message;
use mr360_protocol::intent::{Action, Intent};
use mr360_protocol::join::JoinUrl;
use mr360_protocol::light::{Lift, LightFrame};
use mr360_protocol::scene::{Change, Geometry, Object, ObjectId, Scene, SceneMessage, Shape, Transform};
use mr360_protocol::track;
use mr360_protocol::transport::{self, Certificate, Listener, Roles};
use mr360_protocol::video::{CatalogExtension, CatalogSection, Colour, StereoLayout};
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::process::Program;
use mr360_tests::sandbox::Sandbox;
use tokio::runtime::Runtime;

type Catalog = moq_mux::catalog::Producer<CatalogExtension>;

/// Between the rogue's messages: about the rate of a lively broadcast.
const PACE: Duration = Duration::from_millis(20);

/// Bytes without sense, the same in every run (Marsaglia's xorshift).
fn noise(seed: u64, length: usize) -> Bytes {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as u8
    };
    (0..length).map(|_| next()).collect()
}

/// A server that speaks MoQ well and everything above it badly.
struct Rogue {
    runtime: Runtime,
    url: String,
    origin: moq_net::origin::Producer,
}

impl Rogue {
    fn start(sandbox: &Sandbox) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let guard = runtime.enter();
        let certificate = Certificate::load_or_make(&sandbox.path("rogue"))?;
        let fingerprint = certificate.fingerprint();
        let listener = Listener::bind("127.0.0.1:0".parse()?, certificate)?;
        let endpoint = format!("https://{}/", listener.address()).parse()?;
        let url = JoinUrl { endpoint, room: "live".to_owned(), fingerprint }.to_string();
        let origin = transport::origin();
        runtime.spawn(listener.serve(Roles { publish: Some(origin.consume()), subscribe: None }));
        drop(guard);
        Ok(Self { runtime, url, origin })
    }

    fn broadcast(&self) -> Result<moq_net::broadcast::Producer> {
        let broadcast = self.origin.create_broadcast(track::broadcast_path("live"))?;
        broadcast.announce(moq_net::origin::Route::default())?;
        Ok(broadcast)
    }
}

/// A catalog that announces H.264 video, light and a scene, as a server of this project does.
fn catalog(broadcast: &mut moq_net::broadcast::Producer, version: u32) -> Result<Catalog> {
    let config = moq_mux::catalog::Config::default().with_catalog(hang::Catalog::default());
    let mut catalog = Catalog::new(broadcast, config)?;
    let mut video = hang::catalog::VideoConfig::new("avc3.42c01e".parse::<hang::catalog::VideoCodec>()?);
    (video.coded_width, video.coded_height) = (Some(256), Some(128));
    let mut inserted = Ok(());
    catalog.mutate(|catalog| {
        inserted = catalog.video.insert(track::VIDEO, video).map(drop);
        catalog.ext.mr360 = Some(CatalogSection {
            version,
            stereo: StereoLayout::Mono,
            colour: Colour::default(),
            video: Some(track::VIDEO.to_owned()),
            method: "none".to_owned(),
            light: track::LIGHT.to_owned(),
            scene: track::SCENE.to_owned(),
        });
    })?;
    inserted?;
    Ok(catalog)
}

fn viewer(sandbox: &Sandbox, url: &str, arguments: &[&str]) -> Result<Program> {
    sandbox.join("viewer", url, &[&["--mode", "headless", "--size", "160x90"], arguments].concat())
}

#[test]
fn random_bytes_on_every_track_are_refused_and_survived() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let rogue = Rogue::start(&sandbox)?;
    let _guard = rogue.runtime.enter();
    let mut broadcast = rogue.broadcast()?;
    let _catalog = catalog(&mut broadcast, CatalogSection::VERSION)?;
    let mut light = broadcast.create_track(track::LIGHT, track::light_info())?;
    let scene = broadcast.create_track(track::SCENE, track::scene_info())?;
    let video = broadcast.create_track(track::VIDEO, moq_net::track::Info::default())?;
    // An object of a model whose track holds something else, so that there is a message that is understood, too.
    let asset = AssetId::of(b"the model");
    let mut assets = broadcast.create_track(asset.track(), track::asset_info())?;
    assets.write_frame(moq_net::Timestamp::now(), Bytes::from_static(b"not the model"))?;
    let model = Object {
        id: ObjectId(1),
        geometry: Geometry::Model(asset),
        transform: Transform::default(),
        material: None,
        animation: Default::default(),
    };
    let snapshot = SceneMessage::Snapshot { at_us: 0, scene: Scene { objects: vec![model], ..Scene::default() } }.to_wire()?;
    let dark = LightFrame { pts_us: 0, published_us: 0, lift: Lift::Linear, sh: vec![Vec3::ZERO; 9], lights: Vec::new() };
    let versions = [dark.to_wire()?[0], snapshot[0]];

    let mut victim = viewer(&sandbox, &rogue.url, &["--duration", "8"])?;
    let mut scenes = scene.append_group()?;
    scenes.write_frame(moq_net::Timestamp::now(), snapshot)?;
    let mut sent = 0;
    let mut pace = tokio::time::interval(PACE);
    let deadline = Instant::now() + LONG;
    while victim.is_running() {
        ensure!(Instant::now() < deadline, "the viewer does not end:\n{}", victim.output());
        sent += 1;
        let now = moq_net::Timestamp::now();
        let length = sent as usize * 37 % 3000;
        // Some begin as the real ones do, so that what is behind the version is reached.
        let versioned = |version: u8, seed| [&[version][..], &noise(seed, length)].concat();
        light.write_frame(now, if sent % 2 == 0 { noise(sent, length) } else { Bytes::from(versioned(versions[0], sent)) })?;
        let mut group = video.append_group()?;
        group.write_frame(now, noise(sent + 1, length))?;
        group.write_frame(now, Bytes::from([&[0, 0, 0, 1, 0x65][..], &noise(sent + 2, length)].concat()))?;
        group.finish()?;
        scenes.write_frame(now, Bytes::from(versioned(versions[1], sent + 3)))?;
        if sent % 1000 == 0 {
            scenes.finish()?;
            scenes = scene.append_group()?;
        }
        rogue.runtime.block_on(pace.tick());
    }
    let status = victim.wait_for_exit(LONG)?;
    let output = victim.output();
    // It lives to its end, but a viewer who saw nothing has failed.
    ensure!(status.code() == Some(1) && !output.contains("panicked"), "ended with {status}:\n{output}");
    ensure!(output.contains("error: no picture was shown: video came"), "{output}");
    for refusal in ["light frame: malformed", "light frame: wire version", "scene message: malformed", "its bytes have SHA-256"] {
        ensure!(output.contains(refusal), "{refusal:?} was not reported:\n{output}");
    }
    Ok(())
}

#[test]
fn an_unknown_catalog_version_is_named() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let rogue = Rogue::start(&sandbox)?;
    let _guard = rogue.runtime.enter();
    let mut broadcast = rogue.broadcast()?;
    let _catalog = catalog(&mut broadcast, 77)?;
    let mut client = viewer(&sandbox, &rogue.url, &["--duration", "60"])?;
    let status = client.wait_for_exit(LONG)?;
    let output = client.output();
    ensure!(status.code() == Some(1) && !output.contains("panicked"), "ended with {status}:\n{output}");
    ensure!(output.contains("version 77") && output.contains("use matching"), "{output}");
    Ok(())
}

#[test]
fn a_catalog_of_random_bytes_is_survived() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let rogue = Rogue::start(&sandbox)?;
    let _guard = rogue.runtime.enter();
    let broadcast = rogue.broadcast()?;
    let mut catalog = broadcast.create_track(hang::Catalog::<()>::DEFAULT_NAME, moq_net::track::Info::default())?;
    catalog.write_frame(moq_net::Timestamp::now(), noise(5, 500))?;
    let mut client = viewer(&sandbox, &rogue.url, &["--duration", "3"])?;
    let status = client.wait_for_exit(LONG)?;
    let output = client.output();
    ensure!(status.code() == Some(1) && !output.contains("panicked"), "ended with {status}:\n{output}");
    ensure!(output.contains("error: no picture was shown: the room was found"), "{output}");
    ensure!(output.contains("catalog: "), "the fault was not reported:\n{output}");
    Ok(())
}

const CUBE: &str = "ground_y = -1.6\n[[object]]\nshape = \"cube\"\nposition = [0.0, -1.1, -3.0]\n";

#[test]
fn a_wish_moves_the_object_for_everyone_and_senseless_wishes_move_nothing() -> Result<()> {
    let sandbox = Sandbox::new()?;
    std::fs::write(sandbox.path("SCENE.toml"), CUBE)?;
    let source = "synthetic:testcard?size=256x128&fps=10";
    let mut server = sandbox.serve(source, &["--listen", "127.0.0.1:0", "--scene", "SCENE.toml"])?;
    let [rogue, user, witness] = [0, 1, 2].map(|_| Probe::join(&server.join_url));
    let (rogue, user, witness) = (rogue?, user?, witness?);
    let cube = witness.scene("the first snapshot", |message| match message {
        SceneMessage::Snapshot { scene, .. } => scene.objects.first().cloned(),
        SceneMessage::Delta { .. } => None,
    })?;
    ensure!(cube.geometry == Geometry::Shape(Shape::Cube), "{cube:?}");

    let far = Transform { position: Vec3::splat(9e9), ..cube.transform };
    let mut lies: Vec<Bytes> = (0..200).map(|seed| noise(seed, seed as usize * 3 % 500)).collect();
    // Wellformed up to the last field, which is out of range: the position of a place within bounds, overwritten.
    let place = Intent { sequence: 1, action: Action::Move(cube.id, cube.transform) }.to_wire()?;
    let mut out_of_range = place.to_vec();
    let at = out_of_range.len() - 40;
    out_of_range.splice(at..at + 4, far.position.x.to_le_bytes());
    let mut unknown_version = place.to_vec();
    unknown_version[0] = 99;
    lies.extend([Bytes::from(out_of_range), Bytes::from(unknown_version), noise(7, 4 << 20), Bytes::new()]);
    let _rogue_broadcast = publish_intents(&rogue, "rogue", lies)?;
    for refusal in
        ["intent: position is out of range", "intent: wire version 99", "intent: malformed (4194304 bytes", "intent: malformed (empty"]
    {
        server.program.wait_for_text(refusal, LONG)?;
    }

    let near = Transform { position: Vec3::new(1.0, -1.1, -2.0), ..cube.transform };
    let wish = Intent { sequence: 1, action: Action::Move(cube.id, near) }.to_wire()?;
    let _user_broadcast = publish_intents(&user, "user", vec![wish])?;
    let place = witness.scene("the cube's new place", |message| match message {
        SceneMessage::Snapshot { .. } => None,
        SceneMessage::Delta { changes, .. } => changes.iter().find_map(|change| match change {
            Change::Move(id, transform) if *id == cube.id => Some(*transform),
            _ => None,
        }),
    })?;
    ensure!(place == near, "the first move that anyone saw went to {place:?}");
    let lights: Vec<LightFrame> = witness.lights(10)?;
    ensure!(lights.is_sorted_by_key(|light| light.pts_us), "the broadcast suffers");
    server.program.finish(LONG)?;
    ensure!(!server.program.output().contains("panicked"), "{}", server.program.output());
    Ok(())
}

fn publish_intents(probe: &Probe, user: &str, intents: Vec<Bytes>) -> Result<(moq_net::broadcast::Producer, moq_net::track::Producer)> {
    let broadcast = probe.published().create_broadcast(track::user_path(probe.room(), user)).context("user's broadcast")?;
    let track = broadcast.create_track(track::INTENT, track::scene_info())?;
    broadcast.announce(moq_net::origin::Route::default())?;
    let mut group = track.append_group()?;
    for intent in intents {
        group.write_frame(moq_net::Timestamp::now(), intent)?;
    }
    group.finish()?;
    Ok((broadcast, track))
}
