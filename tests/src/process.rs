//! A program under test: started, listened to, signalled, and ended with the test that started it.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};

/// Lines of output that are kept; older ones are forgotten.
const MAX_LINES: usize = 20_000;
/// Lines of output that an error message repeats.
const QUOTED_LINES: usize = 30;

/// Signals that the tests send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Signal {
    /// As ctrl-c does.
    Interrupt,
    /// As service managers do.
    Terminate,
    /// No chance to tidy up.
    Kill,
    /// Stops reading and writing, but keeps its connections.
    Stop,
    /// Goes on after [`Signal::Stop`].
    Continue,
}

impl Signal {
    fn name(self) -> &'static str {
        match self {
            Self::Interrupt => "INT",
            Self::Terminate => "TERM",
            Self::Kill => "KILL",
            Self::Stop => "STOP",
            Self::Continue => "CONT",
        }
    }
}

/// A running program. Killed when dropped.
pub struct Program {
    name: String,
    child: Child,
    output: Arc<Output>,
    /// Number of the first line that [`Program::wait_for`] looks at.
    mark: usize,
}

impl Program {
    /// Starts `command` with no input, collecting the lines of both its outputs. `name` is for messages.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn spawn(name: &str, command: &mut Command) -> Result<Self> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("{name}: {} does not start", command.get_program().display()))?;
        let output = Arc::new(Output::default());
        let streams: [Option<Box<dyn Read + Send>>; 2] =
            [child.stdout.take().map(|out| Box::new(out) as _), child.stderr.take().map(|err| Box::new(err) as _)];
        for stream in streams.into_iter().flatten() {
            output.lock().open_streams += 1;
            let output = Arc::clone(&output);
            thread::spawn(move || output.collect(stream));
        }
        Ok(Self { name: name.to_owned(), child, output, mark: 0 })
    }

    /// Process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// From here on [`Program::wait_for`] looks only at lines that come after this call.
    pub fn mark(&mut self) {
        self.mark = self.output.lock().end();
    }

    /// Waits for a line that `accept` makes something of, among those since the last [`Program::mark`], or since the start.
    ///
    /// # Errors
    /// When the program ends, or `within` passes, without one. The message says `what` was waited for and
    /// repeats the end of the output.
    pub fn wait_for<T>(&self, what: &str, within: Duration, accept: impl Fn(&str) -> Option<T>) -> Result<T> {
        let mut next = self.mark;
        let mut found = None;
        let reason = self.output.wait_until(within, |lines| {
            found = lines.since(next).find_map(&accept);
            next = lines.end();
            found.is_some()
        });
        match found {
            Some(found) => Ok(found),
            None => bail!("{}: {reason} before {what}; its last words:\n{}", self.name, self.output.lock().tail()),
        }
    }

    /// Waits for a line that contains `text`, and returns it.
    ///
    /// # Errors
    /// As [`Program::wait_for`].
    pub fn wait_for_text(&self, text: &str, within: Duration) -> Result<String> {
        self.wait_for(&format!("{text:?}"), within, |line| line.contains(text).then(|| line.to_owned()))
    }

    /// Waits for the end of the program.
    ///
    /// # Errors
    /// When it still runs after `within`.
    pub fn wait_for_exit(&mut self, within: Duration) -> Result<ExitStatus> {
        // Its outputs close when it ends, which can be waited for with a deadline as the end itself cannot.
        self.output.wait_until(within, |_| false);
        let lines = self.output.lock();
        ensure!(lines.open_streams == 0, "{}: still runs after {within:?}; its last words:\n{}", self.name, lines.tail());
        drop(lines);
        self.child.wait().with_context(|| format!("{}: no exit status", self.name))
    }

    /// Asks it to end, as ctrl-c does, and waits until it has.
    ///
    /// # Errors
    /// When it does not end `within` the time, or ends as failed.
    pub fn finish(&mut self, within: Duration) -> Result<()> {
        self.signal(Signal::Interrupt)?;
        let status = self.wait_for_exit(within)?;
        ensure!(status.success(), "{}: ended with {status}; its last words:\n{}", self.name, self.output.lock().tail());
        Ok(())
    }

    /// Sends a signal.
    ///
    /// # Errors
    /// When the program has ended already.
    pub fn signal(&mut self, signal: Signal) -> Result<()> {
        let ended = self.child.try_wait().with_context(|| format!("{}: no exit status", self.name))?;
        if let Some(status) = ended {
            bail!("{}: has ended ({status}) before {signal:?}; its last words:\n{}", self.name, self.output.lock().tail());
        }
        // The shell's own kill: the standard library sends no signal but KILL.
        let sent = Command::new("sh").args(["-c", "kill -s \"$1\" \"$2\"", "sh", signal.name(), &self.id().to_string()]).status();
        ensure!(sent.context("sh does not start")?.success(), "{}: {signal:?} could not be sent", self.name);
        Ok(())
    }

    /// Ends it without warning and waits until it is gone.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(&mut self) -> Result<ExitStatus> {
        self.child.kill().with_context(|| format!("{}: cannot be killed", self.name))?;
        self.child.wait().with_context(|| format!("{}: no exit status", self.name))
    }

    /// True until it has ended.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Everything it has said, both outputs in the order of arrival.
    #[must_use]
    pub fn output(&self) -> String {
        self.output.lock().since(0).collect::<Vec<_>>().join("\n")
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // Fails only when it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if thread::panicking() {
            eprintln!("{}: its last words:\n{}", self.name, self.output.lock().tail());
        }
    }
}

/// Lines as they arrive, and a bell for who waits for them.
#[derive(Default)]
struct Output {
    lines: Mutex<Lines>,
    changed: Condvar,
}

#[derive(Default)]
struct Lines {
    kept: VecDeque<String>,
    forgotten: usize,
    open_streams: usize,
}

impl Lines {
    fn end(&self) -> usize {
        self.forgotten + self.kept.len()
    }

    fn since(&self, number: usize) -> impl Iterator<Item = &str> {
        self.kept.iter().skip(number.saturating_sub(self.forgotten)).map(String::as_str)
    }

    fn tail(&self) -> String {
        self.since(self.end().saturating_sub(QUOTED_LINES)).map(|line| format!("    {line}\n")).collect()
    }
}

impl Output {
    fn lock(&self) -> MutexGuard<'_, Lines> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn collect(&self, stream: impl Read) {
        let mut stream = BufReader::new(stream);
        let mut line = Vec::new();
        while matches!(stream.read_until(b'\n', &mut line), Ok(1..)) {
            let text = String::from_utf8_lossy(&line).trim_end().to_owned();
            line.clear();
            let mut lines = self.lock();
            if lines.kept.len() == MAX_LINES {
                lines.kept.pop_front();
                lines.forgotten += 1;
            }
            lines.kept.push_back(text);
            self.changed.notify_all();
        }
        self.lock().open_streams -= 1;
        self.changed.notify_all();
    }

    /// Until `enough`, both outputs have closed, or the time is over; says which of the latter two it was.
    fn wait_until(&self, within: Duration, mut enough: impl FnMut(&Lines) -> bool) -> String {
        let deadline = Instant::now() + within;
        let mut lines = self.lock();
        loop {
            if enough(&lines) || lines.open_streams == 0 {
                return "ended".to_owned();
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return format!("{within:?} passed");
            }
            lines = self.changed.wait_timeout(lines, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Far more than any of these takes: a deadline that fires is a failure, never a measurement.
    const LONG: Duration = Duration::from_secs(60);

    fn shell(script: &str) -> Program {
        Program::spawn("script", Command::new("sh").args(["-c", script])).unwrap()
    }

    #[test]
    fn lines_of_both_outputs_are_found() {
        let mut program = shell("echo one; echo two >&2; echo join: url; exit 3");
        assert_eq!(program.wait_for("the URL", LONG, |line| line.strip_prefix("join: ").map(str::to_owned)).unwrap(), "url");
        assert_eq!(program.wait_for_text("two", LONG).unwrap(), "two");
        assert_eq!(program.wait_for_exit(LONG).unwrap().code(), Some(3));
    }

    #[test]
    fn an_end_without_the_line_quotes_the_output() {
        let error = shell("echo cannot bind").wait_for_text("ready", LONG).unwrap_err().to_string();
        assert!(error.contains("script: ended before \"ready\"") && error.contains("cannot bind"), "{error}");
    }

    #[test]
    fn a_deadline_is_kept() {
        let error = shell("exec cat /dev/zero > /dev/null").wait_for_text("ready", Duration::from_millis(1)).unwrap_err();
        assert!(error.to_string().contains("1ms passed"), "{error}");
    }

    #[test]
    fn a_mark_hides_what_came_before() {
        let mut program = shell("echo up; trap 'echo up again; exit 0' INT; echo armed; while :; do :; done");
        program.wait_for_text("armed", LONG).unwrap();
        program.mark();
        program.signal(Signal::Interrupt).unwrap();
        assert_eq!(program.wait_for_text("up", LONG).unwrap(), "up again");
        assert!(program.wait_for_exit(LONG).unwrap().success());
        assert!(program.signal(Signal::Stop).is_err());
    }

    #[test]
    fn killed_is_gone() {
        let mut program = shell("echo up; exec cat /dev/zero > /dev/null");
        program.wait_for_text("up", LONG).unwrap();
        assert!(program.is_running());
        assert!(!program.kill().unwrap().success());
        assert!(!program.is_running());
    }
}
