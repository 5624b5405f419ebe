//! Pictures on their way from the decoder to the frame loop.
//!
//! A frame loop that keeps up takes them at once. One that cannot must not hold the decoder up: what it would show
//! then grows older and older. So a full outbox is waited for briefly, and then gives up its oldest picture.

use std::collections::VecDeque;
use std::sync::mpsc::{RecvTimeoutError, TryRecvError};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::Decoded;

/// Time that a full outbox is waited for. Longer than a turn of a frame loop that keeps up, shorter than a frame of video.
const PATIENCE: Duration = Duration::from_millis(20);

/// A bounded queue with one sender and one receiver.
#[must_use]
pub fn outbox(capacity: usize) -> (PictureSender, PictureReceiver) {
    let shared = Arc::new(Shared { state: Mutex::default(), changed: Condvar::new(), capacity: capacity.max(1) });
    (PictureSender(Arc::clone(&shared)), PictureReceiver(shared))
}

/// The decoder's end. Dropping it ends the stream of pictures.
pub struct PictureSender(Arc<Shared>);

/// The frame loop's end. Dropping it tells the decoder to stop.
pub struct PictureReceiver(Arc<Shared>);

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    capacity: usize,
}

#[derive(Default)]
struct State {
    pictures: VecDeque<Decoded>,
    /// Either end is gone.
    closed: bool,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
}

/// The receiver is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NobodyListens;

impl PictureSender {
    /// Puts a picture in; true when an older one had to go for it.
    ///
    /// # Errors
    /// [`NobodyListens`].
    pub fn send(&self, picture: Decoded) -> Result<bool, NobodyListens> {
        let full = |state: &mut State| state.pictures.len() >= self.0.capacity && !state.closed;
        let waited = self.0.changed.wait_timeout_while(self.0.lock(), PATIENCE, full);
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        if state.closed {
            return Err(NobodyListens);
        }
        let superseded = state.pictures.len() >= self.0.capacity && state.pictures.pop_front().is_some();
        state.pictures.push_back(picture);
        self.0.changed.notify_all();
        Ok(superseded)
    }
}

impl Drop for PictureSender {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl PictureReceiver {
    /// The next picture, if there is one.
    ///
    /// # Errors
    /// As a channel's: empty, or empty and without a sender.
    pub fn try_recv(&self) -> Result<Decoded, TryRecvError> {
        let mut state = self.0.lock();
        let picture = state.pictures.pop_front().ok_or(if state.closed { TryRecvError::Disconnected } else { TryRecvError::Empty })?;
        self.0.changed.notify_all();
        Ok(picture)
    }

    /// The next picture, waited for.
    ///
    /// # Errors
    /// As a channel's: none in time, or no sender any more.
    pub fn recv_timeout(&self, timeout: Duration) -> Result<Decoded, RecvTimeoutError> {
        let deadline = Instant::now() + timeout;
        let mut state = self.0.lock();
        loop {
            if let Some(picture) = state.pictures.pop_front() {
                self.0.changed.notify_all();
                return Ok(picture);
            }
            if state.closed {
                return Err(RecvTimeoutError::Disconnected);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(RecvTimeoutError::Timeout);
            }
            state = self.0.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for PictureReceiver {
    fn drop(&mut self) {
        self.0.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::{Picture, Samples};
    use mr360_protocol::clock::ClientTime;
    use mr360_protocol::video::{StereoLayout, Transfer};

    fn picture(pts_us: u64) -> Decoded {
        let samples = Samples::Rgba16F { texels: Vec::new(), transfer: Transfer::Linear };
        let picture = Picture { pts_us, width: 0, height: 0, stereo: StereoLayout::Mono, samples };
        Decoded { picture, arrived: ClientTime(0), decoded: ClientTime(0), held_us: 0 }
    }

    #[test]
    fn the_oldest_gives_way_and_the_newest_arrives() {
        let (sender, receiver) = outbox(2);
        let superseded: Vec<bool> = (0..5).map(|pts_us| sender.send(picture(pts_us)).unwrap()).collect();
        assert_eq!(superseded, [false, false, true, true, true]);
        drop(sender);
        let left: Vec<u64> = std::iter::from_fn(|| receiver.try_recv().ok()).map(|decoded| decoded.picture.pts_us).collect();
        assert_eq!(left, [3, 4]);
        assert!(matches!(receiver.try_recv(), Err(TryRecvError::Disconnected)));
        assert!(matches!(receiver.recv_timeout(Duration::ZERO), Err(RecvTimeoutError::Disconnected)));
    }

    #[test]
    fn the_sender_learns_that_nobody_listens() {
        let (sender, receiver) = outbox(1);
        assert!(matches!(receiver.recv_timeout(Duration::ZERO), Err(RecvTimeoutError::Timeout)));
        drop(receiver);
        assert_eq!(sender.send(picture(0)), Err(NobodyListens));
    }
}
