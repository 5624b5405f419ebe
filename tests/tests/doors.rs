//! How a broadcast begins and ends for those outside.

use std::net::UdpSocket;

use anyhow::{Context, Result, ensure};
use mr360_tests::probe::LONG;
use mr360_tests::process::{Program, Signal};
use mr360_tests::sandbox::Sandbox;

const CARD: &str = "synthetic:testcard?size=256x128&fps=10";

#[test]
fn a_host_that_ends_in_order_tells_its_viewers() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let mut server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0"])?;
    let mut viewer = sandbox.join("viewer", &server.join_url, &["--mode", "headless", "--size", "160x90"])?;
    viewer.wait_for_text("first picture after", LONG)?;
    server.program.finish(LONG)?;
    viewer.wait_for_text("the host has ended the broadcast", LONG)?;
    viewer.finish(LONG)
}

#[test]
fn a_host_that_ends_in_order_tells_its_relay() -> Result<()> {
    let sandbox = Sandbox::new()?;
    // Any server takes a publisher's connection, and says why it went.
    let mut relay = sandbox.serve(CARD, &["--listen", "127.0.0.1:0", "--room", "other"])?;
    let (endpoint, fingerprint) = relay.join_url.split_once('#').context("a join URL has a fragment")?;
    let sha256 = fingerprint.split(',').find(|part| part.starts_with("sha256=")).context("the URL names the certificate")?;
    let mut server = sandbox.serve(CARD, &["--publish", &format!("{endpoint}#{sha256}")])?;
    relay.program.mark();
    server.program.finish(LONG)?;
    relay.program.wait_for_text("its host has ended the broadcast", LONG)?;
    relay.program.finish(LONG)
}

#[test]
fn nobody_is_invited_through_a_relay_that_was_not_reached() -> Result<()> {
    let sandbox = Sandbox::new()?;
    // Bound, so that nobody else takes the port, and silent.
    let silent = UdpSocket::bind("127.0.0.1:0")?;
    let relay = format!("https://{}/anon?jwt=secret#sha256={}", silent.local_addr()?, "00".repeat(32));
    let mut server = Program::spawn("server", sandbox.server_command()?.args(["serve", "--source", CARD, "--publish", &relay]))?;
    server.wait_for_text("relay not reached; trying again", LONG)?;
    server.signal(Signal::Interrupt)?;
    let status = server.wait_for_exit(LONG)?;
    let output = server.output();
    ensure!(status.success() && !output.contains("join: ") && !output.contains("secret"), "ended with {status}:\n{output}");
    Ok(())
}
