//! What can go wrong with a runtime, and what to do about it.

use openxr::sys::Result as Code;

use crate::frame_loop::{BoxError, FrameError};

/// Why there is no headset to draw for, or no longer.
#[derive(Debug)]
pub(super) enum Fault {
    /// Nothing that waiting would mend: go on without a headset.
    Absent(String),
    /// May be mended by the user or by time: a service that does not run, a headset that is not plugged in.
    Later(String),
    /// All that was made through the runtime is gone, and can be made anew.
    Lost(String),
    /// The GPU is lost, or a frame cannot be drawn.
    Frame(FrameError),
    /// The renderer could not be set up on the headset's GPU.
    Open(BoxError),
    /// A call that should not have failed.
    Failed(String),
}

impl Fault {
    /// What a code means when it came of `action`.
    pub(super) fn of(action: &str, code: Code) -> Self {
        match code {
            Code::ERROR_RUNTIME_UNAVAILABLE => {
                Self::Absent("no OpenXR runtime is installed; install the headset's software, and make it the system's runtime".to_owned())
            }
            Code::ERROR_FORM_FACTOR_UNSUPPORTED => Self::Absent("the OpenXR runtime knows no headsets".to_owned()),
            Code::ERROR_EXTENSION_NOT_PRESENT | Code::ERROR_API_VERSION_UNSUPPORTED => {
                Self::Absent(format!("{action} failed ({code:?}); update the OpenXR runtime"))
            }
            Code::ERROR_FORM_FACTOR_UNAVAILABLE => {
                Self::Later("no headset is connected; plug it in and switch it on, it is looked for again and again".to_owned())
            }
            Code::ERROR_RUNTIME_FAILURE | Code::ERROR_INITIALIZATION_FAILED | Code::ERROR_LIMIT_REACHED => {
                Self::Later(format!("{action} failed ({code:?}); start the headset's software, it is asked again and again"))
            }
            Code::ERROR_INSTANCE_LOST => Self::Lost("the OpenXR runtime has ended".to_owned()),
            Code::ERROR_SESSION_LOST => Self::Lost("the headset was lost".to_owned()),
            code => Self::Failed(format!("{action} failed ({code:?})")),
        }
    }

    /// The same where a session was under way: a runtime that fails then has ended, whatever code it has left for that.
    pub(super) fn within_session(self) -> Self {
        match self {
            Self::Later(detail) => Self::Lost(format!("the OpenXR runtime has ended: {detail}")),
            fault => fault,
        }
    }

    /// As the frame loop knows it.
    pub(super) fn into_frame_error(self, action: &'static str) -> FrameError {
        match self {
            Self::Frame(error) => error,
            Self::Lost(detail) => FrameError::DeviceLost { detail },
            Self::Open(source) => FrameError::Failed { action, source },
            Self::Absent(text) | Self::Later(text) | Self::Failed(text) => FrameError::Failed { action, source: text.into() },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_of_trouble_has_its_answer() {
        let fault = |code| Fault::of("connecting", code);
        assert!(matches!(fault(Code::ERROR_RUNTIME_UNAVAILABLE), Fault::Absent(text) if text.contains("install")));
        assert!(matches!(fault(Code::ERROR_RUNTIME_FAILURE), Fault::Later(text) if text.contains("connecting") && text.contains("start")));
        assert!(matches!(fault(Code::ERROR_FORM_FACTOR_UNAVAILABLE), Fault::Later(text) if text.contains("plug")));
        assert!(matches!(fault(Code::ERROR_HANDLE_INVALID), Fault::Failed(_)));
        // Runtimes that are killed do not always say so.
        assert!(matches!(fault(Code::ERROR_RUNTIME_FAILURE).within_session(), Fault::Lost(text) if text.contains("has ended")));
        assert!(matches!(fault(Code::ERROR_HANDLE_INVALID).within_session(), Fault::Failed(_)));
        // What is lost is opened anew, as a lost GPU is.
        for code in [Code::ERROR_INSTANCE_LOST, Code::ERROR_SESSION_LOST] {
            assert!(matches!(fault(code).into_frame_error("presenting"), FrameError::DeviceLost { .. }), "{code:?}");
        }
        assert!(matches!(fault(Code::ERROR_HANDLE_INVALID).into_frame_error("presenting"), FrameError::Failed { .. }));
    }
}
