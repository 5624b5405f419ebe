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

#[test]
fn a_viewer_that_saw_nothing_has_failed_and_says_why() {
    // Taken and silent: nobody else gets this port.
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let url = format!("https://{}/#sha256={}", silent.local_addr().unwrap(), "00".repeat(32));
    let cache = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_mr360-client"));
    command.env("XDG_CACHE_HOME", cache.path()).args(["join", &url, "--mode", "headless", "--duration", "1"]);
    let output = command.output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("no picture was shown") && error.contains("UDP"), "{error}");
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
