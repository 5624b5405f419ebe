//! Ports for programs that cannot be asked which one the system gave them.

use std::net::{Ipv4Addr, TcpListener, UdpSocket};

use anyhow::{Context, Result};

/// A UDP port of 127.0.0.1 that was free just now. Prefer port 0 where the program tells what it got.
///
/// # Errors
/// When the system has none.
pub fn free_udp_port() -> Result<u16> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).context("no free UDP port on 127.0.0.1")?;
    Ok(socket.local_addr().context("socket without an address")?.port())
}

/// A TCP port of 127.0.0.1 that was free just now.
///
/// # Errors
/// When the system has none.
pub fn free_tcp_port() -> Result<u16> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).context("no free TCP port on 127.0.0.1")?;
    Ok(listener.local_addr().context("socket without an address")?.port())
}
