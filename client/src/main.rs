//! The `mr360-client` program.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use mr360_client::Failure;
use mr360_client::join::{self, JoinArgs};
use mr360_client::render::{self, RenderArgs};
use mr360_protocol::failure;

/// Joins live 360° broadcasts and draws virtual objects into them.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Join(JoinArgs),
    Render(RenderArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let default = "info,moq_net=error,moq_mux=warn,quinn=warn,web_transport_quinn=error,wgpu_core=warn,wgpu_hal=error,naga=warn";
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| default.into());
    // Where nobody reads the log any more, nobody is to be told so.
    let colours = std::io::IsTerminal::is_terminal(&std::io::stderr());
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours).with_writer(std::io::stderr).log_internal_errors(false).init();
    // What fails is told by our own errors; FFmpeg would add a line for every device that it probes in vain.
    ffmpeg_next::log::set_level(ffmpeg_next::log::Level::Fatal);
    let result = ffmpeg_next::init().map_err(|error| Failure::Running(anyhow::anyhow!("FFmpeg cannot be used: {error}")));
    failure::exit(result.and_then(|()| run(cli.command)))
}

fn run(command: Command) -> Result<(), Failure> {
    match command {
        Command::Join(args) => join::run(args),
        Command::Render(args) => render::run(&args),
    }
}
