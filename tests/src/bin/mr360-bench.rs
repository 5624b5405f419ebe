//! Benches of MR360 live: CSV, SVG charts and a Markdown summary in one folder.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};
use mr360_tests::network;

/// Measures MR360 live from outside and writes tables and charts.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    bench: Bench,
}

#[derive(Subcommand)]
enum Bench {
    /// One server and N headless viewers: age of light and video, the server's CPU and memory, bytes per track.
    Network(Network),
    /// Every bench.
    All(Network),
}

#[derive(Args)]
struct Network {
    /// Folder for the results; made where it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Numbers of viewers, one run each.
    #[arg(long, value_delimiter = ',', default_value = "1,2,4", value_name = "N,N,…")]
    viewers: Vec<usize>,
    /// How long each viewer watches.
    #[arg(long, default_value_t = 10, value_name = "SECONDS", value_parser = clap::value_parser!(u32).range(2..=3600))]
    seconds: u32,
    /// What the server broadcasts.
    #[arg(long, default_value = "synthetic:plaza?size=1280x640", value_name = "URL|FILE|synthetic:NAME")]
    source: String,
    /// Size of each viewer's picture.
    #[arg(long, default_value = "320x180", value_name = "WxH")]
    size: String,
}

fn main() -> ExitCode {
    let (Bench::Network(Network { out, viewers, seconds, source, size }) | Bench::All(Network { out, viewers, seconds, source, size })) =
        Cli::parse().bench;
    match network::run(&network::Options { viewers, seconds, source, size, out }) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
