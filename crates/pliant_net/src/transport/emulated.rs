//! A socket over an emulated link: real QUIC over a network that loses, delays and reorders, on one machine and from a seed.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use tokio::sync::Notify;
use tokio::time::{Sleep, sleep_until};

use super::queue::lock;

/// One direction of a link: says when a packet arrives.
pub trait PacketLink: Send + fmt::Debug {
    /// A packet of `bytes` (UDP payload) enters at `now` (since the link began). Pushes the times at which it arrives onto `arrivals`: none
    /// if it is lost, several if it is doubled.
    fn offer(&mut self, now: Duration, bytes: usize, arrivals: &mut Vec<Duration>);
}

/// A link for each direction.
#[derive(Debug)]
pub struct Emulation {
    /// For what this endpoint sends.
    pub outgoing: Box<dyn PacketLink>,
    /// For what it receives.
    pub incoming: Box<dyn PacketLink>,
}

/// A packet on its way.
#[derive(Debug)]
struct Packet {
    due: Instant,
    /// Breaks ties in the order of entry.
    number: u64,
    /// Where to, or where from.
    address: SocketAddr,
    meta: Option<RecvMeta>,
    bytes: Vec<u8>,
}

impl PartialEq for Packet {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Packet {}

impl PartialOrd for Packet {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Packet {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.due, self.number).cmp(&(other.due, other.number))
    }
}

/// What is on its way in one direction.
#[derive(Debug)]
struct Direction {
    link: Box<dyn PacketLink>,
    began: Instant,
    packets: BinaryHeap<Reverse<Packet>>,
    number: u64,
    arrivals: Vec<Duration>,
}

/// Packets under way in one direction; more are lost, as in a router's full queue.
const MOST_UNDER_WAY: usize = 4096;

impl Direction {
    fn new(link: Box<dyn PacketLink>, began: Instant) -> Self {
        Self { link, began, packets: BinaryHeap::new(), number: 0, arrivals: Vec::new() }
    }

    fn enter(&mut self, now: Instant, address: SocketAddr, meta: Option<RecvMeta>, bytes: &[u8]) {
        self.arrivals.clear();
        self.link.offer(now.saturating_duration_since(self.began), bytes.len(), &mut self.arrivals);
        for &at in &self.arrivals {
            if self.packets.len() >= MOST_UNDER_WAY {
                break;
            }
            // A time beyond the clock's range never comes.
            let Some(due) = self.began.checked_add(at) else { continue };
            self.packets.push(Reverse(Packet {
                due,
                number: self.number,
                address,
                meta,
                bytes: bytes.to_vec(),
            }));
            self.number += 1;
        }
    }

    fn due(&self) -> Option<Instant> {
        self.packets.peek().map(|Reverse(packet)| packet.due)
    }

    fn leave(&mut self, now: Instant) -> Option<Packet> {
        if self.due()? > now {
            return None;
        }
        self.packets.pop().map(|Reverse(packet)| packet)
    }
}

/// The real socket with a link on either side of it.
pub(super) struct Emulated {
    socket: Arc<dyn AsyncUdpSocket>,
    outgoing: Arc<Outgoing>,
    incoming: Mutex<Incoming>,
}

struct Outgoing {
    direction: Mutex<Direction>,
    entered: Notify,
}

struct Incoming {
    direction: Direction,
    alarm: Pin<Box<Sleep>>,
    buffers: Vec<Vec<u8>>,
}

impl fmt::Debug for Emulated {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Emulated").field("socket", &self.socket).finish_non_exhaustive()
    }
}

/// Largest UDP payload.
const LARGEST: usize = 65_535;

impl Emulated {
    /// Puts `emulation` under `socket`. Must be called on the network's runtime, which carries the packets from then on.
    pub(super) fn under(
        socket: Arc<dyn AsyncUdpSocket>,
        emulation: Emulation,
    ) -> io::Result<Arc<dyn AsyncUdpSocket>> {
        let began = Instant::now();
        let outgoing = Arc::new(Outgoing {
            direction: Mutex::new(Direction::new(emulation.outgoing, began)),
            entered: Notify::new(),
        });
        tokio::spawn(carry(Arc::clone(&socket), Arc::clone(&outgoing)));
        let segments = socket.max_receive_segments().max(1);
        let incoming = Incoming {
            direction: Direction::new(emulation.incoming, began),
            alarm: Box::pin(sleep_until(began.into())),
            buffers: vec![vec![0; LARGEST.max(segments * 1500)]; BATCH],
        };
        Ok(Arc::new(Self { socket, outgoing, incoming: Mutex::new(incoming) }))
    }
}

/// Packets read from the real socket at a time.
const BATCH: usize = 8;

/// Hands packets to the real socket when they have crossed the link.
async fn carry(socket: Arc<dyn AsyncUdpSocket>, outgoing: Arc<Outgoing>) {
    loop {
        let due = lock(&outgoing.direction).due();
        match due {
            None => outgoing.entered.notified().await,
            // A packet with a shorter delay may enter meanwhile.
            Some(due) => tokio::select! {
                () = sleep_until(due.into()) => {}
                () = outgoing.entered.notified() => {}
            },
        }
        loop {
            let packet = lock(&outgoing.direction).leave(Instant::now());
            let Some(packet) = packet else { break };
            let transmit = Transmit {
                destination: packet.address,
                ecn: None,
                contents: &packet.bytes,
                segment_size: None,
                src_ip: None,
            };
            // A full or failing socket is one more way to lose a packet.
            let _ = socket.try_send(&transmit);
        }
    }
}

/// The link takes whatever comes: its own queue decides what is lost.
#[derive(Debug)]
struct AlwaysWritable;

impl UdpPoller for AlwaysWritable {
    fn poll_writable(self: Pin<&mut Self>, _cx: &mut Context) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

impl AsyncUdpSocket for Emulated {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Box::pin(AlwaysWritable)
    }

    fn try_send(&self, transmit: &Transmit) -> io::Result<()> {
        let now = Instant::now();
        let mut direction = lock(&self.outgoing.direction);
        let size = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
        for segment in transmit.contents.chunks(size) {
            direction.enter(now, transmit.destination, None, segment);
        }
        drop(direction);
        self.outgoing.entered.notify_one();
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut incoming = lock(&self.incoming);
        let Incoming { direction, alarm, buffers } = &mut *incoming;
        // Everything that the real socket has goes onto the link; its waker is registered when it has no more.
        loop {
            let mut metas = [RecvMeta::default(); BATCH];
            let mut slices: Vec<IoSliceMut<'_>> = buffers.iter_mut().map(|b| IoSliceMut::new(b)).collect();
            match self.socket.poll_recv(cx, &mut slices, &mut metas) {
                Poll::Pending => break,
                Poll::Ready(Err(error)) => return Poll::Ready(Err(error)),
                Poll::Ready(Ok(count)) => {
                    let now = Instant::now();
                    for (meta, buffer) in metas.iter().zip(buffers.iter()).take(count) {
                        let bytes = buffer.get(..meta.len).unwrap_or_default();
                        for segment in bytes.chunks(meta.stride.max(1)) {
                            direction.enter(now, meta.addr, Some(*meta), segment);
                        }
                    }
                }
            }
        }
        let now = Instant::now();
        let mut count = 0;
        for (buffer, meta) in bufs.iter_mut().zip(meta.iter_mut()) {
            let Some(packet) = direction.leave(now) else { break };
            // What does not fit is not a QUIC packet of ours; it arrives empty and is ignored.
            let len = if packet.bytes.len() <= buffer.len() { packet.bytes.len() } else { 0 };
            buffer[..len].copy_from_slice(&packet.bytes[..len]);
            let from = packet.meta.unwrap_or_default();
            *meta = RecvMeta { addr: packet.address, len, stride: len, ecn: None, dst_ip: from.dst_ip };
            count += 1;
        }
        if count > 0 {
            return Poll::Ready(Ok(count));
        }
        if let Some(due) = direction.due() {
            alarm.as_mut().reset(due.into());
            if alarm.as_mut().poll(cx).is_ready() {
                cx.waker().wake_by_ref();
            }
        }
        Poll::Pending
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    fn may_fragment(&self) -> bool {
        self.socket.may_fragment()
    }
}
