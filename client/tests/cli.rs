//! The program's outermost contract. That this file stands beside the program makes `cargo test` build the program itself,
//! which the end-to-end tests of the `tests` crate start.

use std::process::Command;

#[test]
fn the_contract_of_the_command_line_holds() {
    for (arguments, code) in [(&["--version"][..], 0), (&["join", "--help"], 0), (&["render", "--help"], 0), (&["dance"], 2), (&[], 2)] {
        let output = Command::new(env!("CARGO_BIN_EXE_mr360-client")).args(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {output:?}");
    }
}

/// A server that never answers, and a viewer's cache of its own.
struct Silent {
    // Taken: nobody else gets this port.
    socket: std::net::UdpSocket,
    cache: tempfile::TempDir,
}

impl Silent {
    fn new() -> std::io::Result<Self> {
        Ok(Self { socket: std::net::UdpSocket::bind("127.0.0.1:0")?, cache: tempfile::tempdir()? })
    }

    /// A viewer that waits for it for a second.
    fn join(&self) -> std::io::Result<Command> {
        let url = format!("https://{}/#sha256={}", self.socket.local_addr()?, "00".repeat(32));
        let mut command = Command::new(env!("CARGO_BIN_EXE_mr360-client"));
        command.env("XDG_CACHE_HOME", self.cache.path()).args(["join", &url, "--mode", "headless", "--duration", "1"]);
        Ok(command)
    }
}

#[test]
fn a_viewer_that_saw_nothing_has_failed_and_says_why() {
    let silent = Silent::new().unwrap();
    let output = silent.join().unwrap().output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("no picture was shown") && error.contains("UDP"), "{error}");
}

#[test]
fn a_log_that_nobody_reads_is_no_failure_of_its_own() {
    let silent = Silent::new().unwrap();
    let mut child = silent.join().unwrap().stdout(std::process::Stdio::null()).stderr(std::process::Stdio::piped()).spawn().unwrap();
    drop(child.stderr.take());
    // That of a viewer that saw nothing.
    assert_eq!(child.wait().unwrap().code(), Some(1));
}

#[test]
fn values_out_of_range_are_named_with_their_range() {
    for (flag, value, range) in [
        ("--duration", "-1", "number of seconds above 0"),
        ("--duration", "0", "number of seconds above 0"),
        ("--fps", "-1", "number of frames above 0"),
        ("--fov-y-deg", "-1", "from 1 to 170"),
        ("--size", "9000x9000", "from 1 to 8192"),
        ("--frames", "0", "1.."),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_mr360-client"));
        let output = command.args(["join", "https://localhost:1/", flag, value]).output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains(range) && !error.contains("tip:"), "{flag} {value}: {error}");
    }
    let help = Command::new(env!("CARGO_BIN_EXE_mr360-client")).arg("--help").output().unwrap();
    let help = String::from_utf8_lossy(&help.stdout).into_owned();
    assert!(help.contains("Draw a scene into a still panorama") && !help.contains("Arguments of"), "{help}");
}

#[test]
fn what_cannot_be_created_is_named_before_anything_is_done() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("SCENE.toml"), "ground_y = -1.6\n").unwrap();
    image::RgbImage::new(2, 1).save(folder.path().join("panorama.png")).unwrap();
    // Nobody is there to be joined: whoever tries to comes back with 1.
    let join = ["join", "https://127.0.0.1:1/", "--mode", "headless", "--duration", "1"];
    let render = ["render", "--panorama", "panorama.png", "--scene", "SCENE.toml", "--size", "16x16"];
    for (command, flags, word) in [
        (&join[..], &["--record", "no/a.mp4"][..], "no/a.mp4"),
        (&join, &["--snapshot", "no/a.png"], "no/a.png"),
        (&join, &["--stats", "no/a.csv"], "no/a.csv"),
        (&render, &["--out", "no/a.png"], "no/a.png"),
        (&render, &["--out", "."], "."),
        (&render, &["--out", "a.txt"], ".png or .jpg"),
        (&render, &["--out", "a.png", "--out-linear", "no/a.exr"], "no/a.exr"),
        (&render, &["--out", "a.png", "--out-linear", "a.png"], ".exr"),
    ] {
        let mut program = Command::new(env!("CARGO_BIN_EXE_mr360-client"));
        program.current_dir(folder.path()).env("XDG_CACHE_HOME", folder.path()).args(command).args(flags);
        let output = program.output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && error.contains(word), "{flags:?}: {}: {error}", output.status);
        assert!(!folder.path().join("a.png").exists() && !folder.path().join("a.png.part").exists(), "{flags:?}");
    }
}

#[test]
fn flags_of_another_mode_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (flags, word) in [
        (&["--mode", "xr", "--snapshot", "a.png"][..], "--mode headless"),
        (&["--mode", "xr", "--record", "a.mp4"], "--mode headless"),
        (&["--mode", "window", "--view", "view.json"], "--mode headless"),
        (&["--mode", "headless", "--view", "no/view.json"], "no/view.json"),
        (&["--mode", "headless", "--record-eyes", "eyes"], "--mode xr"),
        (&["--mode", "xr", "--record-eyes", "/proc/no-such-folder"], "/proc/no-such-folder"),
    ] {
        let mut program = Command::new(env!("CARGO_BIN_EXE_mr360-client"));
        program.current_dir(folder.path()).env("XDG_CACHE_HOME", folder.path()).args(["join", "https://127.0.0.1:1/"]).args(flags);
        let output = program.output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && error.contains(word), "{flags:?}: {}: {error}", output.status);
    }
}
