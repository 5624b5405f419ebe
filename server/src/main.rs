//! The `mr360-server` program.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use mr360_protocol::failure::{self, Failure};
use mr360_server::analyze::{self, AnalyzeArgs};
use mr360_server::ingest::{self, DecodeOptions, Source};
use mr360_server::serve::{self, ServeArgs};
use mr360_server::truth::{self, TruthArgs};

/// Hosts live 360° broadcasts with their light.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Serve(Box<ServeArgs>),
    Analyze(AnalyzeArgs),
    Truth(TruthArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| "info,moq_net=error,moq_mux=warn,quinn=warn,web_transport_quinn=error".into());
    // Where nobody reads the log any more, nobody is to be told so.
    let colours = std::io::IsTerminal::is_terminal(&std::io::stderr());
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours).with_writer(std::io::stderr).log_internal_errors(false).init();
    match cli.command {
        Command::Serve(args) => failure::exit(serve(*args)),
        Command::Analyze(args) => failure::exit(analyze(&args)),
        Command::Truth(args) => failure::exit(truth::run(&args)),
    }
}

fn serve(args: ServeArgs) -> Result<(), Failure<anyhow::Error>> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
    runtime.map_err(|error| Failure::Running(error.into()))?.block_on(serve::run(args))
}

fn analyze(args: &AnalyzeArgs) -> Result<(), Failure<anyhow::Error>> {
    analyze::run(args, |args| {
        let source = Source::parse(&args.source)?;
        let options = DecodeOptions { stereo: args.stereo.map(Into::into), ..DecodeOptions::default() };
        Ok(ingest::decode_frames(&source, options)?)
    })
}
