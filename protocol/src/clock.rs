//! Server time and client time are different types: they are only ever related through [`ClockOffset`].

/// Microseconds since the server started the broadcast.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ServerTime(pub u64);

/// Microseconds since the client started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientTime(pub u64);

/// Client clock minus server clock, estimated from one-way arrivals.
///
/// The smallest (arrival − departure) seen is the offset plus the least network delay; every other arrival's
/// excess over it is queueing. Without a return path the least delay itself cannot be told from the offset,
/// so ages measured with this are lower bounds by that constant. The minimum leaks upwards by
/// [`ClockOffset::DRIFT_PPM`], so that clocks that drift apart are followed.
#[derive(Debug, Default, Clone, Copy)]
pub struct ClockOffset {
    best: Option<(i64, ClientTime)>,
}

impl ClockOffset {
    /// Drift that is followed, parts per million: four times what consumer crystals are specified to.
    pub const DRIFT_PPM: i64 = 200;

    /// Takes in one message that left at `departed` and arrived at `arrived`.
    pub fn observe(&mut self, departed: ServerTime, arrived: ClientTime) {
        let difference = i64::try_from(arrived.0).unwrap_or(i64::MAX).saturating_sub_unsigned(departed.0);
        let leaked = self.at(arrived);
        if leaked.is_none_or(|best| difference <= best) {
            self.best = Some((difference, arrived));
        }
    }

    /// Client time at which the server's clock read `time`, or `None` before the first observation.
    #[must_use]
    pub fn client_from_server(&self, time: ServerTime, now: ClientTime) -> Option<ClientTime> {
        let offset = self.at(now)?;
        let client = i64::try_from(time.0).unwrap_or(i64::MAX).saturating_add(offset);
        Some(ClientTime(u64::try_from(client).unwrap_or(0)))
    }

    /// What the server's clock reads at `now`, or `None` before the first observation. Behind by the least network delay: what was so then
    /// can be here by now.
    #[must_use]
    pub fn server_from_client(&self, now: ClientTime) -> Option<ServerTime> {
        let server = i64::try_from(now.0).unwrap_or(i64::MAX).saturating_sub(self.at(now)?);
        Some(ServerTime(u64::try_from(server).unwrap_or(0)))
    }

    fn at(&self, now: ClientTime) -> Option<i64> {
        let (best, since) = self.best?;
        let elapsed = i64::try_from(now.0.saturating_sub(since.0)).unwrap_or(i64::MAX);
        Some(best.saturating_add(elapsed.saturating_mul(Self::DRIFT_PPM) / 1_000_000))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offset_is_the_least_delay_and_follows_drift() {
        let mut offset = ClockOffset::default();
        assert_eq!(offset.client_from_server(ServerTime(5), ClientTime(0)), None);
        offset.observe(ServerTime(1_000), ClientTime(6_000));
        offset.observe(ServerTime(2_000), ClientTime(5_500));
        offset.observe(ServerTime(3_000), ClientTime(9_900));
        assert_eq!(offset.client_from_server(ServerTime(3_000), ClientTime(9_900)), Some(ClientTime(6_500)));
        assert_eq!(offset.server_from_client(ClientTime(9_900)), Some(ServerTime(6_400)));
        // After ten seconds 2,000 µs of drift are allowed for.
        offset.observe(ServerTime(10_002_000), ClientTime(10_007_000));
        assert_eq!(offset.client_from_server(ServerTime(10_002_000), ClientTime(10_007_000)), Some(ClientTime(10_007_000)));
    }
}
