//! How far the way to the first picture was come, for those who never see it.

use std::borrow::Cow;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::anyhow;
use mr360_protocol::transport::{DialError, LinkEvent};

use crate::decode::DecodeError;
use crate::headless::HeadlessError;
use crate::receive::Event;

/// What keeps the first picture away, as last heard. Written by the network's side, read when nothing was shown.
#[derive(Clone)]
pub(super) struct Standing(Arc<Mutex<Cow<'static, str>>>);

impl Standing {
    pub(super) fn new() -> Self {
        let text = "the server has not answered yet; run longer, and check that it runs and can be reached over UDP";
        Self(Arc::new(Mutex::new(text.into())))
    }

    /// Takes note of how far the link and the room are.
    pub(super) fn hear(&self, event: &Event) {
        match event {
            Event::Link(LinkEvent::Up(_)) => {
                self.set("the server answered, but nothing of the room came; run longer, and check the room's name");
            }
            Event::Link(LinkEvent::Down { fault: fault @ DialError::HostEnded { .. }, .. }) => self.set(fault.to_string()),
            Event::Link(LinkEvent::Down { fault, .. } | LinkEvent::Failed { fault, .. }) => {
                self.set(format!("{fault}; is the server running, and can it be reached over UDP?"));
            }
            Event::Joined => self.set("the room was found, but no video came; the log says if its catalog is damaged"),
            Event::AwaitingSource => self.set("the room is open, but its source has not come; ask the host"),
            _ => {}
        }
    }

    /// The decoder takes the room's video.
    pub(super) fn video_came(&self) {
        self.set("video came, but no picture and light that belong together; the summary counts what became of both");
    }

    /// The decoder refuses the room's video.
    pub(super) fn cannot_decode(&self, error: &DecodeError) {
        self.set(error.to_string());
    }

    fn set(&self, text: impl Into<Cow<'static, str>>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = text.into();
    }

    fn text(&self) -> Cow<'static, str> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What the run came to. One that ended by itself and has shown nothing has failed, whatever the presenter says.
    ///
    /// # Errors
    /// The presenter's, or what kept the first picture away.
    pub(super) fn judge(&self, presented: anyhow::Result<()>, frames: u64, stopped: bool) -> anyhow::Result<()> {
        let of_its_own = match &presented {
            Ok(()) => false,
            // Of both, what kept the picture away says more.
            Err(error) => !matches!(error.downcast_ref(), Some(HeadlessError::NoPicture)),
        };
        if of_its_own || frames > 0 || stopped { presented } else { Err(anyhow!("no picture was shown: {}", self.text())) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_showed_nothing_has_failed_unless_the_user_ended_it() {
        let standing = Standing::new();
        assert!(standing.judge(Ok(()), 1, false).is_ok());
        assert!(standing.judge(Ok(()), 0, true).is_ok());
        assert!(standing.judge(Ok(()), 0, false).unwrap_err().to_string().contains("has not answered"));
        standing.hear(&Event::AwaitingSource);
        assert!(standing.judge(Ok(()), 0, false).unwrap_err().to_string().contains("its source has not come"));
        let no_snapshot = || Err(HeadlessError::NoPicture.into());
        assert!(standing.judge(no_snapshot(), 0, false).unwrap_err().to_string().contains("its source has not come"));
        assert!(standing.judge(no_snapshot(), 0, true).unwrap_err().to_string().contains("no snapshot"));
        assert!(standing.judge(Err(anyhow!("no adapter")), 0, false).unwrap_err().to_string().contains("no adapter"));
    }
}
