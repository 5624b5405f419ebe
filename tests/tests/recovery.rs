//! Killed, restarted, stopped: each part in turn, while the others are watched getting over it.

use anyhow::{Context, Result, ensure};
use mr360_tests::probe::{LONG, Probe};
use mr360_tests::process::{Program, Signal};
use mr360_tests::samples::Samples;
use mr360_tests::sandbox::Sandbox;
use mr360_tests::{clips, ports, usage};

/// Small and cheap: recovery, not throughput, is what these are about.
const CARD: &str = "synthetic:testcard?size=256x128&fps=10";
/// Frames whose light shows that the broadcast runs.
const SOME: usize = 15;

fn watch(sandbox: &Sandbox, name: &str, url: &str) -> Result<Program> {
    let stats = format!("{name}.csv");
    let viewer = sandbox.join(name, url, &["--mode", "headless", "--size", "160x90", "--stats", &stats])?;
    viewer.wait_for_text("first picture after", LONG)?;
    Ok(viewer)
}

/// Frames in the recording, and frames that were left out, by the viewer's own count.
fn recorded(output: &str) -> Result<(usize, usize)> {
    let line = output.lines().find_map(|line| line.split_once("recording written ")).context("no recording was written")?.1;
    let count = |name: &str| {
        let count = line.split(' ').find_map(|field| field.strip_prefix(name)?.strip_prefix('=')?.parse().ok());
        count.with_context(|| format!("no {name} in {line:?}"))
    };
    Ok((count("frames")?, count("dropped")?))
}

/// Ends the viewer and returns the pts of what it showed, in order.
fn shown(sandbox: &Sandbox, name: &str, viewer: &mut Program) -> Result<Vec<u64>> {
    viewer.finish(LONG)?;
    let pts = Samples::load(&sandbox.path(&format!("{name}.csv")))?.column("pts_us")?;
    Ok(pts.into_iter().flatten().map(|pts| pts as u64).collect())
}

#[test]
fn a_killed_source_is_awaited_and_its_successor_shown() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let clip = clips::stereo(&sandbox, "clip.flv", 500)?;
    let push_url = format!("rtmp://127.0.0.1:{}/live/KEY", ports::free_tcp_port()?);
    let server = sandbox.serve(&format!("{push_url}?listen=1"), &["--listen", "127.0.0.1:0", "--stereo", "top-bottom"])?;
    let mut source = sandbox.push(&clip, &push_url)?;
    let mut viewer = watch(&sandbox, "viewer", &server.join_url)?;
    let probe = Probe::join(&server.join_url)?;
    let before = probe.pts_after(SOME)?;

    source.kill()?;
    server.program.wait_for_text("source lost; trying again", LONG)?;
    let _successor = sandbox.push(&clip, &push_url)?;
    server.program.wait_for_text("again=true", LONG)?;
    let after = probe.pts_after(SOME)?;
    ensure!(after > before, "the broadcast's time went back from {before} to {after}");
    // Two GOPs later the viewer has had a keyframe of the successor and time to show it.
    probe.lights(2 * clips::GOP)?;
    let shown = shown(&sandbox, "viewer", &mut viewer)?;
    ensure!(shown.iter().any(|&pts| pts >= after), "nothing of the successor was shown, which began before {after}: {shown:?}");
    Ok(())
}

#[test]
fn a_killed_server_comes_back_under_the_same_url() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let address = format!("127.0.0.1:{}", ports::free_udp_port()?);
    let mut server = sandbox.serve(CARD, &["--listen", &address])?;
    let url = server.join_url.clone();
    let arguments = ["--mode", "headless", "--size", "160x90", "--stats", "viewer.csv", "--record", "viewer.mp4"];
    let mut viewer = sandbox.join("viewer", &url, &arguments)?;
    viewer.wait_for_text("first picture after", LONG)?;
    let probe = Probe::join(&url)?;
    // Long enough that the first server's time is past all that the second one reaches below.
    let before = probe.pts_after(12 * SOME)?;

    viewer.mark();
    server.restart()?;
    ensure!(server.join_url == url, "{} is now {}", url, server.join_url);
    viewer.wait_for_text("connection lost; trying again", LONG)?;
    viewer.wait_for_text("joined the room", LONG)?;
    let again = probe.pts_after(2 * SOME)?;
    ensure!(again < before, "the new broadcast began before {again}, the old one ended after {before}");
    let shown = shown(&sandbox, "viewer", &mut viewer)?;
    let back = shown.windows(2).position(|pair| pair[1] < pair[0]);
    let back = back.with_context(|| format!("nothing of the new broadcast was shown: {shown:?}"))?;
    let (recorded, left_out) = recorded(&viewer.output())?;
    ensure!(recorded + left_out == shown.len(), "{recorded} of {} pictures are recorded, {left_out} are said to be left out", shown.len());
    ensure!(left_out < shown.len() - back - 1, "the recording ended with the first broadcast: {left_out} pictures are left out");
    Ok(())
}

#[test]
fn a_killed_viewer_is_missed_by_nobody_and_may_come_back() -> Result<()> {
    let sandbox = Sandbox::new()?;
    let mut server = sandbox.serve(CARD, &["--listen", "127.0.0.1:0"])?;
    let mut other = watch(&sandbox, "other", &server.join_url)?;
    let mut victim = watch(&sandbox, "victim", &server.join_url)?;
    server.program.mark();
    victim.kill()?;
    server.program.wait_for_text("viewer gone", LONG)?;
    let mut reborn = watch(&sandbox, "reborn", &server.join_url)?;
    let probe = Probe::join(&server.join_url)?;
    let after = probe.pts_after(1)?;
    probe.lights(SOME)?;
    ensure!(shown(&sandbox, "reborn", &mut reborn)?.last().is_some_and(|&pts| pts >= after), "the viewer that came back saw nothing new");
    ensure!(shown(&sandbox, "other", &mut other)?.last().is_some_and(|&pts| pts >= after), "the other viewer stands still");
    ensure!(server.program.is_running(), "the server has ended");
    Ok(())
}

#[test]
fn a_viewer_that_stops_reading_harms_no_one() -> Result<()> {
    /// Most bytes that QUIC keeps for a viewer until it acknowledges them: quinn's send window, eight streams' windows of 1.25 MB.
    const SEND_WINDOW: f64 = 8.0 * 1.25e6;
    /// Video that the viewer's subscription keeps: half a second, from the last keyframe before it on.
    const KEPT_S: f64 = 0.5 + clips::GOP_US as f64 / 1e6;
    /// Frames of the time before the standstill and of the standstill: 15 s each.
    const SPAN: usize = 15 * clips::GOP;
    /// Bits of video asked for, more than the noise can fill.
    const KBITS: u32 = 40_000;

    let sandbox = Sandbox::new()?;
    let clip = clips::stereo(&sandbox, "clip.mp4", KBITS)?;
    let source = clip.display().to_string();
    let mut server = sandbox.serve(&source, &["--loop", "--listen", "127.0.0.1:0", "--stereo", "top-bottom", "--stats", "server.csv"])?;
    let mut other = watch(&sandbox, "other", &server.join_url)?;
    let mut stopped = watch(&sandbox, "stopped", &server.join_url)?;
    let probe = Probe::join(&server.join_url)?;
    // The transport keeps groups for ten seconds; after those its cache has what it needs. What the process grows by from then on
    // while everyone reads is the allocator's.
    probe.lights(11 * clips::GOP)?;
    let peak = || Ok::<_, anyhow::Error>(usage::memory(server.program.id())?.peak as f64);
    let warm = peak()?;
    probe.lights(SPAN)?;
    let before = peak()?;
    stopped.signal(Signal::Stop)?;
    let stopped_at = probe.pts_after(1)?;
    let during = probe.pts_after(SPAN)?;
    let after = peak()?;
    stopped.signal(Signal::Continue)?;
    let continued_at = probe.pts_after(1)?;
    probe.lights(5 * clips::GOP)?;

    let shown_by_other = shown(&sandbox, "other", &mut other)?;
    let while_stopped = shown_by_other.iter().filter(|&&pts| (stopped_at..during).contains(&pts)).count();
    ensure!(while_stopped > SPAN / 3, "the other viewer was shown {while_stopped} of {SPAN} pictures meanwhile");
    let caught_up = shown(&sandbox, "stopped", &mut stopped)?;
    ensure!(caught_up.iter().any(|&pts| pts >= continued_at), "the stopped viewer did not catch up with {continued_at}: {caught_up:?}");
    server.program.finish(LONG)?;
    let sent = Samples::load(&sandbox.path("server.csv"))?;
    let sizes = sent.column("pts_us")?.into_iter().zip(sent.column("video_bytes")?);
    let meanwhile = sizes.filter(|(pts, _)| pts.is_some_and(|pts| (stopped_at as f64..during as f64).contains(&pts)));
    let sent: f64 = meanwhile.filter_map(|(_, bytes)| bytes).sum();
    let bytes_per_s = sent * 1e6 / (during - stopped_at) as f64;
    let may_hold = SEND_WINDOW + KEPT_S * bytes_per_s;
    ensure!(sent > 2.0 * may_hold, "only {sent} bytes of video were sent where {may_hold} may be held, too few to tell");
    let (usual, growth) = (before - warm, after - before);
    ensure!(growth < usual + may_hold, "the server grew by {growth} bytes; {usual} are usual and {may_hold} may be held");
    Ok(())
}
