//! The `mr360-server` program.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use mr360_server::analyze::{self, AnalyzeArgs};
use mr360_server::ingest::{self, DecodeOptions, Source};
use mr360_server::serve::{self, Failure, ServeArgs};
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
    let filter =
        tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info,moq_net=error,moq_mux=warn,quinn=warn".into());
    let colours = std::io::IsTerminal::is_terminal(&std::io::stderr());
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours).with_writer(std::io::stderr).init();
    match cli.command {
        Command::Serve(args) => serve(*args),
        Command::Analyze(args) => analyze(&args).map_err(Failure::Input),
        Command::Truth(args) => truth::run(&args).map_err(Failure::Input),
    }
    .map_or_else(report, |()| ExitCode::SUCCESS)
}

/// Exit codes: 1 failed while running, 2 wrong usage or input.
fn report(failure: Failure) -> ExitCode {
    let (error, code) = match failure {
        Failure::Running(error) => (error, 1),
        Failure::Input(error) => (error, 2),
    };
    eprintln!("error: {error:#}");
    ExitCode::from(code)
}

fn serve(args: ServeArgs) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
    runtime.map_err(|error| Failure::Running(error.into()))?.block_on(serve::run(args))
}

fn analyze(args: &AnalyzeArgs) -> anyhow::Result<()> {
    analyze::run(args, |args| {
        let source = Source::parse(&args.source)?;
        let options = DecodeOptions { stereo: args.stereo.map(Into::into), ..DecodeOptions::default() };
        Ok(ingest::decode_frames(&source, options)?)
    })
}
