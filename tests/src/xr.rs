//! A headset without hardware: Monado's service with its null compositor and its remote driver, whose poses and buttons are scripted.
//!
//! The compositor shows 20 frames a second of 320×240 pixels an eye to nobody. Each runtime has a folder and a port of its own, so that several
//! run side by side.

use std::fs;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use glam::{Quat, Vec2, Vec3};

use crate::ports;
use crate::process::Program;
use crate::sandbox::{Sandbox, xr_runtime_folder};

/// Longest wait for the service, on a machine that other tests keep busy.
const START_WITHIN: Duration = Duration::from_secs(120);
/// Bytes of an update of the remote driver (Monado 25, `struct r_remote_data`, little endian).
const UPDATE_BYTES: usize = 376;
/// What each begins with.
const UPDATE_HEADER: &[u8; 8] = b"mndrmt3\0";

/// An OpenXR runtime; its service is ended when dropped.
pub struct XrRuntime {
    folder: PathBuf,
    port: u16,
    service: Option<Program>,
}

impl XrRuntime {
    /// A runtime whose service does not run yet.
    ///
    /// # Errors
    /// When it is not installed, or there is no port for it.
    pub fn new(sandbox: &Sandbox, name: &str) -> Result<Self> {
        xr_runtime_folder()?;
        let (folder, port) = (sandbox.path(name), ports::free_tcp_port()?);
        let settings = folder.join("monado");
        fs::create_dir_all(&settings).context("the runtime's folder")?;
        let remote = format!("{{\"active\":\"remote\",\"remote\":{{\"version\":0,\"port\":{port},\"view_count\":2}}}}");
        fs::write(settings.join("config_v0.json"), remote).context("the runtime's settings")?;
        Ok(Self { folder, port, service: None })
    }

    /// Starts the service and waits until programs can connect to it.
    ///
    /// # Errors
    /// When it ends instead.
    pub fn start(&mut self) -> Result<()> {
        let mut command = self.script("service")?;
        // Its last word is then that it is ready.
        command.arg("IPC_LOG=info");
        let service = Program::spawn("monado-service", &mut command)?;
        service.wait_for_text("The Monado service has started", START_WITHIN)?;
        self.service = Some(service);
        Ok(())
    }

    /// Ends the service without warning.
    ///
    /// # Errors
    /// When it does not run.
    pub fn kill(&mut self) -> Result<()> {
        self.service.take().context("the service does not run")?.kill()?;
        Ok(())
    }

    /// Starts `mr360-client join URL --mode xr ARGUMENTS…` on this runtime.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn join(&self, sandbox: &Sandbox, name: &str, url: &str, arguments: &[&str]) -> Result<Program> {
        let mut command = sandbox.client_command_by(self.script("run")?)?;
        // No window mirrors it on whatever display there is.
        command.args(["join", url]).args(arguments).env_remove("DISPLAY").env_remove("WAYLAND_DISPLAY");
        Program::spawn(name, &mut command)
    }

    /// As [`XrRuntime::join`], with a window on this display.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn join_on_display(&self, sandbox: &Sandbox, display: &str, url: &str, arguments: &[&str]) -> Result<Program> {
        let mut command = sandbox.client_command_by(self.script("run")?)?;
        command.args(["join", url]).args(arguments).env("DISPLAY", display).env_remove("WAYLAND_DISPLAY");
        Program::spawn("viewer", &mut command)
    }

    /// What starts a program on the runtime and with its Vulkan driver, to be given its path and arguments.
    ///
    /// # Errors
    /// When the path of this program is not known.
    pub fn starter(&self) -> Result<Command> {
        self.script("run")
    }

    /// Connects to the driver of head and hands.
    ///
    /// # Errors
    /// When the service does not run.
    pub fn remote(&self) -> Result<Remote> {
        let mut stream = TcpStream::connect((Ipv4Addr::LOCALHOST, self.port)).context("the runtime's remote driver does not listen")?;
        stream.set_nodelay(true)?;
        // It tells how everything is at rest, and how it is now.
        stream.read_exact(&mut [0; 2 * UPDATE_BYTES]).context("the runtime's remote driver says nothing")?;
        Ok(Remote(stream))
    }

    fn script(&self, what: &str) -> Result<Command> {
        let mut command = Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/xr-runtime"));
        command.arg(what).env("MR360_XR_HOME", xr_runtime_folder()?).env("MR360_XR_SESSION", &self.folder);
        Ok(command)
    }
}

/// A pose above the floor: position in metres, and orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scripted {
    /// Metres; x right, y up from the floor.
    pub position: Vec3,
    /// Unit quaternion.
    pub orientation: Quat,
}

/// A controller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScriptedHand {
    /// Where it is; `None` for one that is switched off.
    pub pose: Option<Scripted>,
    /// 0 to 1.
    pub trigger: f32,
    /// 0 to 1.
    pub squeeze: f32,
    /// Each −1 to 1.
    pub stick: Vec2,
    /// The upper button.
    pub b: bool,
}

/// Angles of an eye's field of view, radians: left, right, up, down.
pub type Angles = [f32; 4];

/// Everything at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Script {
    /// Between the eyes.
    pub head: Scripted,
    /// Fields of view, and places of the eyes to the right of the head's centre, metres; left, right.
    pub eyes: [(Angles, f32); 2],
    /// Left, right.
    pub hands: [ScriptedHand; 2],
}

/// A connection to the driver of head and hands.
pub struct Remote(TcpStream);

impl Remote {
    /// Head and hands are so from the next frame on.
    ///
    /// # Errors
    /// When the service has ended.
    pub fn set(&mut self, script: &Script) -> Result<()> {
        self.0.write_all(&encode(script)).context("the runtime's remote driver has gone")
    }
}

fn encode(script: &Script) -> [u8; UPDATE_BYTES] {
    let mut update = [0; UPDATE_BYTES];
    update[..UPDATE_HEADER.len()].copy_from_slice(UPDATE_HEADER);
    let mut put = |at: usize, values: &[f32]| {
        for (slot, value) in update[at..].chunks_exact_mut(4).zip(values) {
            slot.copy_from_slice(&value.to_le_bytes());
        }
    };
    let floats = |pose: &Scripted| {
        let ([x, y, z, w], [px, py, pz]) = (pose.orientation.to_array(), pose.position.to_array());
        [x, y, z, w, px, py, pz]
    };
    for (at, (angles, aside)) in [8, 56].into_iter().zip(&script.eyes) {
        put(at, angles);
        put(at + 16, &floats(&Scripted { position: Vec3::X * *aside, orientation: Quat::IDENTITY }));
    }
    put(104, &floats(&script.head));
    for (at, hand) in [136, 256].into_iter().zip(&script.hands) {
        put(at, &floats(&hand.pose.unwrap_or(Scripted { position: Vec3::ZERO, orientation: Quat::IDENTITY })));
        put(at + 72, &[hand.trigger]);
        put(at + 76, &[hand.squeeze]);
        put(at + 84, &hand.stick.to_array());
    }
    // Fields of view and eyes count.
    update[132] = 1;
    for (at, hand) in [136, 256].into_iter().zip(&script.hands) {
        update[at + 105] = u8::from(hand.pose.is_some());
        update[at + 110] = u8::from(hand.b);
        update[at + 112] = u8::from(hand.trigger > 0.5);
    }
    update
}

/// Lines that `--record-eyes` wrote, each a JSON value.
///
/// # Errors
/// When there are none, or one is no JSON.
pub fn kept_frames(folder: &Path) -> Result<Vec<serde_json::Value>> {
    let text = fs::read_to_string(folder.join("frames.jsonl")).context("frames.jsonl")?;
    let lines: Vec<_> = text.lines().map(serde_json::from_str).collect::<Result<_, _>>().context("frames.jsonl")?;
    ensure!(!lines.is_empty(), "frames.jsonl is empty");
    Ok(lines)
}
