//! The same binary publishes to a real moq-relay, and everyone gets over its restart.

use std::process::Command;

use anyhow::{Context, Result, ensure};
use mr360_protocol::transport::Certificate;
use mr360_tests::ports;
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::process::Program;
use mr360_tests::sandbox::{Sandbox, tool};

const CARD: &str = "synthetic:testcard?size=256x128&fps=10";
/// Frames whose light shows that the broadcast runs.
const SOME: usize = 15;

fn relay(sandbox: &Sandbox, address: &str) -> Result<Program> {
    let mut command = Command::new(tool("moq-relay")?);
    command.args(["--listen", address, "--auth-public", "**"]);
    command.arg("--listen-tls-cert").arg(sandbox.path("certificate.pem")).arg("--listen-tls-key").arg(sandbox.path("key.pem"));
    let relay = Program::spawn("moq-relay", &mut command)?;
    relay.wait_for_text("listening", LONG)?;
    Ok(relay)
}

#[test]
fn a_broadcast_through_a_relay_survives_its_restart() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let fingerprint = Certificate::load_or_make(&sandbox.path(""))?.fingerprint().context("a self-signed certificate has a fingerprint")?;
    let hex: String = fingerprint.iter().map(|byte| format!("{byte:02x}")).collect();
    let address = format!("127.0.0.1:{}", ports::free_udp_port()?);
    let mut first = relay(&sandbox, &address)?;
    let server = sandbox.serve(CARD, &["--publish", &format!("https://{address}/#sha256={hex}"), "--room", "stage"])?;
    ensure!(server.join_url.contains(&address) && server.join_url.contains("room=stage"), "{}", server.join_url);
    let mut viewer = sandbox.join("viewer", &server.join_url, &["--mode", "headless", "--size", "160x90"])?;
    viewer.wait_for_text("first picture after", LONG)?;
    let probe = Probe::join(&server.join_url)?;
    let before = probe.pts_after(SOME)?;

    viewer.mark();
    first.kill()?;
    let _second = relay(&sandbox, &address)?;
    server.program.wait_for_text("relay lost; trying again", LONG)?;
    viewer.wait_for_text("connection lost; trying again", LONG)?;
    viewer.wait_for_text("joined the room", LONG)?;
    let after = probe.pts_after(SOME)?;
    ensure!(after > before, "the broadcast's time went back from {before} to {after}");
    viewer.finish(LONG)
}
