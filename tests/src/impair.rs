//! A bad network between one viewer and its server: a UDP relay on 127.0.0.1 that loses datagrams, the same ones in every run of as many.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use anyhow::{Context, Result};

/// Largest UDP payload.
const MAX_DATAGRAM: usize = 65_535;
/// How often the relay looks whether it is to end.
const LOOK: Duration = Duration::from_millis(100);

/// Relays between whoever sends to it last and one server, until dropped.
pub struct Impaired {
    port: u16,
    over: Arc<AtomicBool>,
    lost: Arc<AtomicU64>,
    ways: Vec<JoinHandle<()>>,
}

impl Impaired {
    /// Loses this share of the datagrams to `server`, and of those from it.
    ///
    /// # Errors
    /// When the system has no sockets for it.
    pub fn start(server: SocketAddr, share: f64, seed: u64) -> Result<Self> {
        let socket = || -> Result<UdpSocket> {
            let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).context("no free UDP port on 127.0.0.1")?;
            socket.set_read_timeout(Some(LOOK))?;
            Ok(socket)
        };
        let (near, far) = (Arc::new(socket()?), Arc::new(socket()?));
        let port = near.local_addr()?.port();
        let viewer = Arc::new(Mutex::new(None));
        let (over, lost) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let way = |from: &Arc<UdpSocket>, to: &Arc<UdpSocket>, towards_server: bool| {
            let (from, to, viewer) = (Arc::clone(from), Arc::clone(to), Arc::clone(&viewer));
            let (over, lost) = (Arc::clone(&over), Arc::clone(&lost));
            let mut dice = Dice(seed ^ u64::from(towards_server) << 63 | 1);
            thread::spawn(move || {
                let mut datagram = vec![0; MAX_DATAGRAM];
                while !over.load(Ordering::Relaxed) {
                    let Ok((length, sender)) = from.recv_from(&mut datagram) else { continue };
                    let mut known = viewer.lock().unwrap_or_else(PoisonError::into_inner);
                    if towards_server {
                        *known = Some(sender);
                    }
                    let receiver = if towards_server { Some(server) } else { *known };
                    drop(known);
                    if dice.unit() < share {
                        lost.fetch_add(1, Ordering::Relaxed);
                    } else if let Some(receiver) = receiver {
                        // A datagram that cannot be sent is a lost one.
                        let _ = to.send_to(&datagram[..length], receiver);
                    }
                }
            })
        };
        let ways = vec![way(&near, &far, true), way(&far, &near, false)];
        Ok(Self { port, over, lost, ways })
    }

    /// Where viewers send to instead of to the server.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Datagrams lost so far.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

impl Drop for Impaired {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        for way in self.ways.drain(..) {
            // A way that has panicked has nothing more to say.
            let _ = way.join();
        }
    }
}

/// Marsaglia's xorshift64* (2003, Vigna 2014).
struct Dice(u64);

impl Dice {
    /// In [0, 1).
    fn unit(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sends 200 datagrams through a relay to a server that sends each back, and counts those that return.
    fn returned(share: f64) -> (usize, u64) {
        let server = UdpSocket::bind("127.0.0.1:0").unwrap();
        let relay = Impaired::start(server.local_addr().unwrap(), share, 7).unwrap();
        let viewer = UdpSocket::bind("127.0.0.1:0").unwrap();
        for socket in [&server, &viewer] {
            socket.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
        }
        viewer.connect(("127.0.0.1", relay.port())).unwrap();
        let mut buffer = [0; 8];
        let mut back = 0;
        for number in 0..200_u8 {
            let lost = relay.lost();
            viewer.send(&[number]).unwrap();
            // Either it arrives, or the relay says that it has lost it: whichever comes first.
            while relay.lost() == lost {
                server.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
                let Ok((_, from)) = server.recv_from(&mut buffer) else { continue };
                server.send_to(&buffer[..1], from).unwrap();
                viewer.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
                while relay.lost() == lost {
                    if viewer.recv(&mut buffer).is_ok() {
                        assert_eq!(buffer[0], number);
                        back += 1;
                        break;
                    }
                }
                break;
            }
        }
        (back, relay.lost())
    }

    #[test]
    fn what_is_not_lost_arrives_and_comes_back() {
        assert_eq!(returned(0.0), (200, 0));
        // The same dice every time; each way has its own.
        let (back, lost) = returned(0.25);
        assert_eq!(back as u64 + lost, 200);
        assert!((70..=140).contains(&back), "{back}");
        assert_eq!(returned(0.25), (back, lost));
        assert_eq!(returned(1.0), (0, 200));
    }
}
