//! How a program ends: what failed, and the exit code that tells it.

use std::fmt::Display;
use std::io::Write as _;
use std::process::ExitCode;

/// Why a command ended before it was done. `E` is the program's own error.
#[derive(Debug)]
pub enum Failure<E> {
    /// Wrong usage, an input that cannot be used, or a path the user named that cannot be created: found at start-up, nothing was done.
    Input(E),
    /// What was begun broke off.
    Running(E),
}

impl<E> Failure<E> {
    /// The code of the command-line contract: 1 failed while running, 2 wrong usage or input.
    #[must_use]
    pub fn code(&self) -> u8 {
        match self {
            Self::Running(_) => 1,
            Self::Input(_) => 2,
        }
    }
}

/// Ends a program: reports a failure with its causes as `error: …` on standard error, and gives the exit code.
pub fn exit<E: Display>(result: Result<(), Failure<E>>) -> ExitCode {
    let Err(failure) = result else { return ExitCode::SUCCESS };
    let code = failure.code();
    let (Failure::Input(error) | Failure::Running(error)) = failure;
    say(format_args!("error: {error:#}"));
    ExitCode::from(code)
}

/// A line on standard error. Where nobody reads it any more it is lost, and the program goes on: its exit code still tells how it ended.
pub fn say(line: impl Display) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_those_of_the_contract() {
        assert_eq!((Failure::Running("").code(), Failure::Input("").code()), (1, 2));
        assert_eq!(format!("{:?}", exit::<String>(Ok(()))), format!("{:?}", ExitCode::SUCCESS));
        assert_eq!(format!("{:?}", exit(Err(Failure::Input("no such file")))), format!("{:?}", ExitCode::from(2)));
    }
}
