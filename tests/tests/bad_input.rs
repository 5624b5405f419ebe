//! What users get wrong, through the command line: the exit code, and an error that names input, fault and remedy.

use std::net::{TcpListener, UdpSocket};
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use mr360_tests::clips;
use mr360_tests::probe::LONG;
use mr360_tests::process::Program;
use mr360_tests::sandbox::Sandbox;

const CARD: &str = "synthetic:testcard?size=256x128&fps=10";
/// Exit codes of the command-line contract.
const FAILED: i32 = 1;
const WRONG: i32 = 2;

/// Runs it to its end and checks how it ended: with this code, every one of these words in its error, and no panic. Returns what
/// it said.
fn output_of_failure(command: &mut Command, code: i32, words: &[&str]) -> Result<String> {
    let mut program = Program::spawn("program", command)?;
    let status = program.wait_for_exit(LONG)?;
    let output = program.output();
    let context = || format!("{command:?} ended with {status}:\n{output}");
    ensure!(status.code() == Some(code), "expected exit code {code}; {}", context());
    ensure!(!output.contains("panicked"), "{}", context());
    // Libraries print errors of their own before; the program's is the last, and clap's is followed by usage.
    let from_error = output.rfind("\nerror: ").map_or(output.as_str(), |at| &output[at..]);
    ensure!(from_error.contains("error: "), "no error; {}", context());
    for word in words {
        ensure!(from_error.contains(word), "{word:?} is not in the error; {}", context());
    }
    Ok(output)
}

fn fails(command: &mut Command, code: i32, words: &[&str]) -> Result<()> {
    output_of_failure(command, code, words).map(drop)
}

fn serve(sandbox: &Sandbox, source: &str, arguments: &[&str]) -> Result<Command> {
    let mut command = sandbox.server_command()?;
    command.args(["serve", "--listen", "127.0.0.1:0", "--source", source]).args(arguments);
    Ok(command)
}

fn join(sandbox: &Sandbox, url: &str, arguments: &[&str]) -> Result<Command> {
    let mut command = sandbox.client_command()?;
    command.args(["join", url, "--mode", "headless", "--size", "160x90"]).args(arguments);
    Ok(command)
}

#[test]
fn a_server_without_a_usable_source_says_so() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let video = |name: &str, size: &str| clips::make(&sandbox, name, &format!("-f lavfi -i testsrc=size={size}:duration=1"));
    let whole = std::fs::read(video("whole.mp4", "64x32")?)?;
    video("square.mp4", "64x64")?;
    clips::make(&sandbox, "dot.mkv", "-f lavfi -i color=size=16x16:duration=1 -vf scale=1:1 -c:v ffv1")?;
    clips::make(&sandbox, "sound.m4a", "-f lavfi -i sine=duration=1")?;
    std::fs::write(sandbox.path("zero.mp4"), b"")?;
    std::fs::write(sandbox.path("text.mp4"), b"This is a letter, not a video.\n".repeat(40))?;
    // The index of an MP4 file stands at its end.
    std::fs::write(sandbox.path("cut.mp4"), &whole[..whole.len() / 2])?;
    for (source, words) in [
        ("missing.mp4", &["missing.mp4", "no such file", "give an existing"][..]),
        (".", &["not a regular file"]),
        ("zero.mp4", &["zero.mp4", "empty"]),
        ("text.mp4", &["text.mp4", "not a video", "ffprobe"]),
        ("cut.mp4", &["cut.mp4", "damaged", "ffprobe"]),
        ("sound.m4a", &["sound.m4a", "no video stream"]),
        ("dot.mkv", &["dot.mkv", "1×1", "scale"]),
        ("gopher://host/x", &["gopher", "rtmp"]),
        ("rtmp://host:99999/live", &["rtmp://host:99999", "port"]),
        ("synthetic:moon", &["moon", "plaza"]),
        ("synthetic:testcard?size=big", &["testcard", "size"]),
    ] {
        fails(&mut serve(&sandbox, source, &[])?, WRONG, words)?;
    }
    fails(&mut serve(&sandbox, "square.mp4", &["--projection", "fisheye"])?, WRONG, &["--projection", "dual-fisheye"])?;
    // A flag that merely does not fit the picture is the user's word; the log tells what was made of it.
    let mut program = Program::spawn("server", &mut serve(&sandbox, "square.mp4", &["--projection", "cubemap"])?)?;
    let status = program.wait_for_exit(LONG)?;
    ensure!(status.success() && program.output().contains("its projection is Cubemap"), "{}", program.output());
    Ok(())
}

#[test]
fn a_server_with_wrong_settings_says_so() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let (udp, tcp) = (UdpSocket::bind("127.0.0.1:0")?, TcpListener::bind("127.0.0.1:0")?);
    let taken = udp.local_addr()?.to_string();
    let mut command = sandbox.server_command()?;
    fails(command.args(["serve", "--source", CARD, "--listen", &taken]), WRONG, &[&taken, "--listen"])?;
    let push = format!("rtmp://{}/live/KEY?listen=1", tcp.local_addr()?);
    fails(&mut serve(&sandbox, &push, &[])?, WRONG, &["port", "in use", "choose another"])?;
    fails(sandbox.server_command()?.args(["serve", "--listen", "127.0.0.1:0"]), WRONG, &["no source", "--source"])?;
    std::fs::write(sandbox.path("typo.toml"), "sauce = 1\n")?;
    std::fs::write(sandbox.path("broken.toml"), "source = \n")?;
    for (arguments, words) in [
        (["--method", "magic"], &["magic", "directional"][..]),
        (["--config", "typo.toml"], &["typo.toml", "sauce", "source"]),
        (["--config", "broken.toml"], &["broken.toml", "line 1"]),
        (["--config", "missing.toml"], &["missing.toml"]),
        (["--room", "a/b"], &["--room", "a-z"]),
        (["--publish", "relay"], &["--publish", "relay", "https://"]),
        (["--certificate", "mine.pem"], &["--key"]),
        (["--stats", "nowhere/server.csv"], &["nowhere/server.csv"]),
        (["--scene", "missing.toml"], &["missing.toml"]),
    ] {
        fails(&mut serve(&sandbox, CARD, &arguments)?, WRONG, words)?;
    }
    let pair = ["--certificate", "mine.pem", "--key", "mine.key"];
    fails(&mut serve(&sandbox, CARD, &pair)?, WRONG, &["mine.pem", "check the path"])
}

#[test]
fn a_server_with_a_wrong_scene_names_the_field() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let object = "ground_y = 0.0\n[[object]]\n";
    for (text, words) in [
        ("[[object]]", &["ground_y"][..]),
        ("ground_y = 0.0\nsky = 1", &["sky"]),
        (object, &["object 1", "neither shape nor model"]),
        (&format!("{object}shape = \"torus\""), &["torus", "sphere"]),
        (&format!("{object}shape = \"cube\"\nposition = [inf, 0.0, 0.0]"), &["object 1", "position"]),
        (&format!("{object}shape = \"cube\"\nscale = 0.0"), &["object 1", "scale"]),
        (&format!("{object}shape = \"cube\"\nrotation_deg = [nan, 0.0, 0.0]"), &["object 1", "rotation_deg"]),
        (&format!("{object}shape = \"cube\"\nmaterial = {{ roughness = 2.0 }}"), &["object 1", "roughness"]),
        (&format!("{object}shape = \"cube\"\nmaterial = {{ kind = \"wood\" }}"), &["wood", "glass"]),
        (&format!("{object}model = \"missing.glb\""), &["object 1", "missing.glb"]),
    ] {
        std::fs::write(sandbox.path("SCENE.toml"), text)?;
        let words = [&["SCENE.toml"], words].concat();
        fails(&mut serve(&sandbox, CARD, &["--scene", "SCENE.toml"])?, WRONG, &words)?;
    }
    Ok(())
}

#[test]
fn a_client_that_cannot_join_says_so() -> Result<()> {
    let sandbox = Sandbox::new()?;
    for (url, words) in [
        ("nonsense", &["nonsense", "expected https://"][..]),
        ("http://127.0.0.1:1/", &["http", "not https"]),
        ("https://127.0.0.1:1/#sha256=12", &["64 hexadecimal"]),
        ("https://127.0.0.1:1/#colour=red", &["colour=red"]),
    ] {
        fails(&mut join(&sandbox, url, &[])?, WRONG, words)?;
    }
    let silent = UdpSocket::bind("127.0.0.1:0")?;
    let nobody = format!("https://{}/#sha256={}", silent.local_addr()?, "00".repeat(32));
    for (arguments, words) in [(["--size", "0x90"], "WIDTHxHEIGHT"), (["--fov-y-deg", "400"], "--fov-y-deg"), (["--fps", "0"], "--fps")] {
        let mut command = sandbox.client_command()?;
        fails(command.args(["join", &nobody, "--mode", "headless"]).args(arguments), WRONG, &[words])?;
    }
    fails(&mut join(&sandbox, &nobody, &["--stats", "nowhere/viewer.csv"])?, WRONG, &["nowhere/viewer.csv"])?;
    fails(&mut join(&sandbox, &nobody, &[])?, FAILED, &["127.0.0.1", "is the server running"])?;

    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0", "--room", "stage"])?;
    let (endpoint, print) = server.join_url.split_once("sha256=").context("a join URL has a fingerprint")?;
    let wrong = format!("{endpoint}sha256={}", "11".repeat(32));
    fails(&mut join(&sandbox, &wrong, &[])?, FAILED, &[print, &"11".repeat(32), "ask the host"])?;
    let elsewhere = server.join_url.replace("room=stage", "room=cellar");
    fails(&mut join(&sandbox, &elsewhere, &[])?, FAILED, &["cellar", "open rooms: stage", "join URL"])
}

#[test]
fn a_client_without_vulkan_says_so() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0"])?;
    let no_driver = sandbox.path("no-driver.json");
    let mut command = join(&sandbox, &server.join_url, &["--frames", "1"])?;
    command.env("VK_ICD_FILENAMES", &no_driver).env("VK_DRIVER_FILES", &no_driver);
    fails(&mut command, FAILED, &["Vulkan", "driver"])
}

#[test]
fn files_that_cannot_be_written_are_named_and_the_session_goes_on() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0"])?;
    std::os::unix::fs::symlink("/dev/full", sandbox.path("full.mp4"))?;
    // Full from the start: nothing is recorded, and everything is shown.
    let mut full = join(&sandbox, &server.join_url, &["--frames", "10", "--record", "full.mp4", "--snapshot", "full.png"])?;
    let output = output_of_failure(&mut full, FAILED, &["full.mp4", "space"])?;
    ensure!(
        output.contains("10 frames presented") && sandbox.path("full.png").is_file(),
        "the session ended with the recording:\n{output}"
    );
    // Full after 4 KiB (8 blocks of 512 bytes), by a limit on the size of files that is reported and not fatal.
    let recording = join(&sandbox, &server.join_url, &["--frames", "60", "--record", "cut.mp4"])?;
    let mut limited = Command::new("sh");
    limited.args(["-c", "trap '' XFSZ; ulimit -f 8; exec \"$0\" \"$@\""]).arg(recording.get_program()).args(recording.get_args());
    limited.current_dir(sandbox.path("."));
    limited.envs(recording.get_envs().filter_map(|(name, value)| Some((name, value?))));
    let output = output_of_failure(&mut limited, FAILED, &["cut.mp4"])?;
    ensure!(output.contains("60 frames presented"), "the session ended with the recording:\n{output}");
    fails(&mut join(&sandbox, &server.join_url, &["--frames", "1", "--record", "nowhere/a.mp4"])?, WRONG, &["nowhere/a.mp4", "folder"])?;
    fails(&mut join(&sandbox, &server.join_url, &["--frames", "1", "--snapshot", "nowhere/a.png"])?, WRONG, &["nowhere/a.png", "folder"])
}

#[test]
fn a_bench_without_a_folder_for_its_results_says_so() -> Result<()> {
    let mut bench = Command::new(env!("CARGO_BIN_EXE_mr360-bench"));
    fails(bench.args(["network", "--out", "/proc/mr360"]), WRONG, &["--out /proc/mr360", "another folder"])
}

#[test]
fn a_broken_model_is_left_out_by_the_viewer() -> Result<()> {
    let sandbox = Sandbox::new()?;
    std::fs::write(sandbox.path("broken.glb"), b"glTF\x02\x00\x00\x00 and then nothing of the kind")?;
    std::fs::write(sandbox.path("SCENE.toml"), "ground_y = -1.6\n[[object]]\nmodel = \"broken.glb\"\n")?;
    let server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0", "--scene", "SCENE.toml"])?;
    let mut command = join(&sandbox, &server.join_url, &["--frames", "10", "--snapshot", "view.png"])?;
    let mut viewer = Program::spawn("viewer", &mut command)?;
    let status = viewer.wait_for_exit(LONG)?;
    let output = viewer.output();
    ensure!(status.success() && !output.contains("panicked"), "{output}");
    let warning = output.lines().find(|line| line.contains("object 1 is not drawn")).with_context(|| output.clone())?;
    ensure!(warning.contains("not a valid glTF 2.0 file") && warning.contains("it is left out"), "{warning}");
    ensure!(Path::new(&sandbox.path("view.png")).is_file(), "no snapshot");
    Ok(())
}
