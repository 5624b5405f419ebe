//! Who sends: the ffmpeg program, and a web server of a few lines.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A port that was free for TCP a moment ago.
pub(super) fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// An even UDP port that was free a moment ago, and the next one too: RTP takes the one and RTCP the other.
pub(super) fn free_udp_ports() -> u16 {
    loop {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        if port.is_multiple_of(2) && UdpSocket::bind(("127.0.0.1", port + 1)).is_ok() {
            return port;
        }
    }
}

/// A shell and what it runs, ended with the test.
pub(super) struct Sender {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Sender {
    /// Sends a file in real time, trying until somebody takes it whole.
    pub(super) fn start(path: &Path, arguments: &str, url: &str) -> Self {
        let file = path.display();
        Self::script(&format!(
            "for i in $(seq 100); do ffmpeg -hide_banner -loglevel quiet -re -i '{file}' {arguments} '{url}' </dev/null && exit 0; sleep 0.1; done"
        ))
    }

    /// Runs a shell script.
    pub(super) fn script(script: &str) -> Self {
        let mut command = Command::new("sh");
        command.args(["-c", script]).stdout(Stdio::piped()).stderr(Stdio::null()).process_group(0);
        let mut child = command.spawn().unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        Self { child, output }
    }

    /// Until the script has written a line that contains `text`.
    pub(super) fn wait_for(&mut self, text: &str) {
        let found = self.output.by_ref().lines().any(|line| line.unwrap().contains(text));
        assert!(found, "the sender ended without {text:?}");
    }

    /// From now on it is silent, and keeps its connection.
    pub(super) fn fall_silent(&self) {
        assert!(self.signal("STOP"));
    }

    fn signal(&self, name: &str) -> bool {
        Command::new("sh")
            .args(["-c", "kill -s \"$1\" -- -\"$2\"", "sh", name, &self.child.id().to_string()])
            .stderr(Stdio::null())
            .status()
            .unwrap()
            .success()
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        // Fails where all of it has ended.
        self.signal("KILL");
        drop(self.child.wait());
    }
}

/// What the web server answers.
pub(super) enum Answer {
    NotFound,
    Whole(Vec<u8>),
    /// These bytes, and then nothing, for as long as the client stays.
    Stalled(Vec<u8>),
}

/// A web server on 127.0.0.1.
pub(super) struct Web {
    address: SocketAddr,
    stopped: Arc<AtomicBool>,
}

impl Web {
    /// Starts it; `answer` is given the path that is asked for, without its slash.
    pub(super) fn start(answer: impl Fn(&str) -> Answer + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let (stopped, answer) = (Arc::new(AtomicBool::new(false)), Arc::new(answer));
        let web = Self { address, stopped: Arc::clone(&stopped) };
        std::thread::spawn(move || {
            while let Ok((stream, _)) = listener.accept() {
                if stopped.load(Ordering::Relaxed) {
                    return;
                }
                let answer = Arc::clone(&answer);
                // A client that breaks off is no fault of the test.
                std::thread::spawn(move || drop(serve(stream, answer.as_ref())));
            }
        });
        web
    }

    pub(super) fn url(&self, path: &str) -> String {
        format!("http://{}/{path}", self.address)
    }
}

impl Drop for Web {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        drop(TcpStream::connect(self.address));
    }
}

fn serve(mut stream: TcpStream, answer: &(impl Fn(&str) -> Answer + ?Sized)) -> std::io::Result<()> {
    let mut lines = BufReader::new(stream.try_clone()?).lines();
    let request = lines.next().transpose()?.unwrap_or_default();
    for header in lines {
        if header?.is_empty() {
            break;
        }
    }
    let path = request.split(' ').nth(1).unwrap_or_default().trim_start_matches('/');
    match answer(path) {
        Answer::NotFound => stream.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"),
        Answer::Whole(body) => {
            write!(stream, "HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len())?;
            stream.write_all(&body)
        }
        Answer::Stalled(body) => {
            stream.write_all(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n")?;
            stream.write_all(&body)?;
            stream.read(&mut [0]).map(drop)
        }
    }
}
