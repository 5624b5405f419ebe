//! The way from the inbox to the frame loop.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};

use crate::frame_loop::Arrival;

/// Messages that wait for the frame loop: several seconds of a busy broadcast.
const CAPACITY: usize = 2048;

/// The sending end. It never blocks: while the frame loop stands still, what finds no room is dropped and counted. That a new
/// broadcast has begun is never dropped, but told as soon as there is room.
pub(super) struct Arrivals {
    sender: SyncSender<Arrival>,
    /// A new broadcast has yet to be told of.
    reset_due: bool,
    dropped: Arc<AtomicU64>,
}

impl Arrivals {
    /// Both ends of the way.
    pub(super) fn new() -> (Self, Receiver<Arrival>) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, Receiver<Arrival>) {
        let (sender, receiver) = sync_channel(capacity);
        (Self { sender, reset_due: false, dropped: Arc::default() }, receiver)
    }

    /// How many messages were dropped; stays readable after this end is gone.
    pub(super) fn dropped(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.dropped)
    }

    pub(super) fn send(&mut self, arrival: Arrival) {
        // Whatever comes after a reset must not come before it.
        if self.reset_due && !matches!(arrival, Arrival::NewBroadcast) {
            self.try_send(Arrival::NewBroadcast);
            if self.reset_due {
                self.count();
                return;
            }
        }
        self.try_send(arrival);
    }

    fn try_send(&mut self, arrival: Arrival) {
        let reset = matches!(arrival, Arrival::NewBroadcast);
        let full = matches!(self.sender.try_send(arrival), Err(TrySendError::Full(_)));
        // A frame loop that has ended takes nothing more; the whole client is about to.
        if reset {
            self.reset_due = full;
        } else if full {
            self.count();
        }
    }

    fn count(&self) {
        if self.dropped.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::warn!("the frame loop stands still; lights that come meanwhile are dropped");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(arrival: &Arrival) -> Option<usize> {
        match arrival {
            Arrival::Bytes(_, bytes) => Some(*bytes),
            _ => None,
        }
    }

    #[test]
    fn what_finds_no_room_is_counted_and_a_new_broadcast_is_told_in_order() {
        let (mut arrivals, receiver) = Arrivals::with_capacity(2);
        let dropped = arrivals.dropped();
        let mut send = |bytes| arrivals.send(Arrival::Bytes("light".into(), bytes));
        (0..4).for_each(&mut send);
        assert_eq!(dropped.load(Ordering::Relaxed), 2);
        arrivals.send(Arrival::NewBroadcast);
        arrivals.send(Arrival::Bytes("light".into(), 4));
        assert_eq!(receiver.try_iter().map(|arrival| bytes(&arrival)).collect::<Vec<_>>(), [Some(0), Some(1)]);
        arrivals.send(Arrival::Bytes("light".into(), 5));
        assert_eq!(receiver.try_iter().map(|arrival| bytes(&arrival)).collect::<Vec<_>>(), [None, Some(5)]);
        assert_eq!(dropped.load(Ordering::Relaxed), 3);
        drop(receiver);
        arrivals.send(Arrival::NewBroadcast);
        arrivals.send(Arrival::Bytes("light".into(), 6));
        assert_eq!(dropped.load(Ordering::Relaxed), 3);
    }
}
