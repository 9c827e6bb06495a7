//! A socket over an emulated link: real QUIC over a network that loses, delays and reorders
//! packets, on one machine and with a seed.

use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Preset};
use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use tokio::sync::Notify;
use tokio::time::{Sleep, sleep_until};

use super::queue::lock;

/// An emulated link for each direction of one endpoint, and the seed of their random numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Emulation {
    /// The link for packets that this endpoint sends.
    pub outgoing: LinkConfig,
    /// The link for packets that this endpoint receives.
    pub incoming: LinkConfig,
    /// Seed of all random numbers on the two links. With real sockets the times of the packets
    /// differ from run to run, and so do the lost packets.
    pub seed: u64,
}

impl Emulation {
    /// Creates a named network with the same link in both directions.
    pub fn preset(preset: Preset, seed: u64) -> Self {
        let link = LinkConfig::preset(preset);
        Self { outgoing: link.clone(), incoming: link, seed }
    }
}

/// A packet on a link.
#[derive(Debug, Clone)]
struct Packet {
    /// Destination of an outgoing packet, source of an incoming one.
    address: SocketAddr,
    /// The local address at which an incoming packet arrived.
    to: Option<IpAddr>,
    bytes: Bytes,
}

/// One direction of the emulation, in real time.
#[derive(Debug)]
struct Direction {
    link: EmulatedLink<Packet>,
    began: Instant,
}

impl Direction {
    fn new(config: LinkConfig, seed: u64, began: Instant) -> Self {
        Self { link: EmulatedLink::new(config, seed), began }
    }

    fn enter(&mut self, now: Instant, address: SocketAddr, to: Option<IpAddr>, bytes: &[u8]) {
        let packet = Packet { address, to, bytes: Bytes::copy_from_slice(bytes) };
        self.link.send(now.saturating_duration_since(self.began), packet, bytes.len());
    }

    /// Returns when the next packet arrives. A time beyond the clock's range counts as never.
    fn due(&self) -> Option<Instant> {
        self.began.checked_add(self.link.next_wakeup()?)
    }

    fn leave(&mut self, now: Instant) -> Option<Packet> {
        self.link.poll(now.saturating_duration_since(self.began))
    }
}

/// The emulated links of one endpoint, which may be set and removed while it runs.
#[derive(Debug, Default)]
pub(super) struct Emulator {
    outgoing: Mutex<Option<Direction>>,
    incoming: Mutex<Option<Direction>>,
    /// The current emulation.
    emulation: Mutex<Option<Emulation>>,
    /// Notified when a packet has entered or the socket has changed.
    changed: Notify,
    /// Number of the socket in use.
    generation: AtomicU64,
}

impl Emulator {
    /// Returns the current emulation.
    pub(super) fn get(&self) -> Option<Emulation> {
        lock(&self.emulation).clone()
    }

    /// Sets, replaces or removes the links. Packets on the old links are lost. If the new links
    /// have the same seed, the old links continue with the new settings instead, and their packets
    /// arrive.
    pub(super) fn set(&self, emulation: Option<Emulation>) {
        let before = std::mem::replace(&mut *lock(&self.emulation), emulation.clone());
        let began = Instant::now();
        let same = before.map(|before| before.seed) == emulation.as_ref().map(|new| new.seed);
        let place = |direction: &Mutex<Option<Direction>>, new: Option<(LinkConfig, u64)>| {
            let mut direction = lock(direction);
            if same
                && let (Some(running), Some((config, _))) = (&mut *direction, &new)
                && running.link.reconfigure(config.clone()).is_ok()
            {
                return;
            }
            *direction = new.map(|(config, seed)| Direction::new(config, seed, began));
        };
        let (outgoing, incoming) = match emulation {
            None => (None, None),
            Some(Emulation { outgoing, incoming, seed }) => {
                (Some((outgoing, seed.wrapping_mul(2))), Some((incoming, seed.wrapping_mul(2) | 1)))
            }
        };
        place(&self.outgoing, outgoing);
        place(&self.incoming, incoming);
        self.changed.notify_one();
    }
}

/// The real socket with a link in each direction, or with none.
pub(super) struct Emulated {
    socket: Arc<dyn AsyncUdpSocket>,
    emulator: Arc<Emulator>,
    reading: Mutex<Reading>,
}

struct Reading {
    alarm: Pin<Box<Sleep>>,
    /// Buffers for received packets, allocated when the first link is set.
    buffers: Vec<Vec<u8>>,
}

impl fmt::Debug for Emulated {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Emulated").field("socket", &self.socket).finish_non_exhaustive()
    }
}

/// Largest UDP payload, bytes.
const LARGEST: usize = 65_535;

impl Emulated {
    /// Puts `emulator` under `socket`, instead of the socket that it was under before. Must be
    /// called on the network runtime, which then carries the packets.
    pub(super) fn under(
        socket: Arc<dyn AsyncUdpSocket>,
        emulator: &Arc<Emulator>,
    ) -> Arc<dyn AsyncUdpSocket> {
        let generation = emulator.generation.fetch_add(1, Ordering::AcqRel) + 1;
        tokio::spawn(carry(Arc::clone(&socket), Arc::clone(emulator), generation));
        emulator.changed.notify_one();
        let alarm = Box::pin(sleep_until(Instant::now().into()));
        let reading = Mutex::new(Reading { alarm, buffers: Vec::new() });
        Arc::new(Self { socket, emulator: Arc::clone(emulator), reading })
    }
}

/// Packets read from the real socket at a time.
const BATCH: usize = 8;

/// Sends packets on the real socket when they leave the link, until another socket replaces this
/// one.
async fn carry(socket: Arc<dyn AsyncUdpSocket>, emulator: Arc<Emulator>, generation: u64) {
    loop {
        let due = lock(&emulator.outgoing).as_ref().and_then(Direction::due);
        match due {
            None => emulator.changed.notified().await,
            // A packet with a shorter delay may enter while this waits.
            Some(due) => tokio::select! {
                () = sleep_until(due.into()) => {}
                () = emulator.changed.notified() => {}
            },
        }
        if emulator.generation.load(Ordering::Acquire) != generation {
            // The notification was meant for the task of the next socket.
            emulator.changed.notify_one();
            return;
        }
        loop {
            let packet = lock(&emulator.outgoing).as_mut().and_then(|link| link.leave(Instant::now()));
            let Some(packet) = packet else { break };
            let transmit = Transmit {
                destination: packet.address,
                ecn: None,
                contents: &packet.bytes,
                segment_size: None,
                src_ip: None,
            };
            // A full or failing socket loses the packet, like the link.
            let _ = socket.try_send(&transmit);
        }
    }
}

/// Reports whether a packet can be sent. A link accepts every packet, because its own queue
/// determines the losses. Without a link, the socket reports it.
#[derive(Debug)]
struct Poller {
    emulator: Arc<Emulator>,
    socket: Pin<Box<dyn UdpPoller>>,
}

impl UdpPoller for Poller {
    fn poll_writable(mut self: Pin<&mut Self>, cx: &mut Context) -> Poll<io::Result<()>> {
        if lock(&self.emulator.outgoing).is_some() {
            return Poll::Ready(Ok(()));
        }
        self.socket.as_mut().poll_writable(cx)
    }
}

impl AsyncUdpSocket for Emulated {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        let socket = Arc::clone(&self.socket).create_io_poller();
        Box::pin(Poller { emulator: Arc::clone(&self.emulator), socket })
    }

    fn try_send(&self, transmit: &Transmit) -> io::Result<()> {
        let mut link = lock(&self.emulator.outgoing);
        let Some(direction) = link.as_mut() else {
            drop(link);
            return self.socket.try_send(transmit);
        };
        let now = Instant::now();
        let size = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
        for segment in transmit.contents.chunks(size) {
            direction.enter(now, transmit.destination, None, segment);
        }
        drop(link);
        self.emulator.changed.notify_one();
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut link = lock(&self.emulator.incoming);
        let Some(direction) = link.as_mut() else {
            drop(link);
            return self.socket.poll_recv(cx, bufs, meta);
        };
        let mut reading = lock(&self.reading);
        let Reading { alarm, buffers } = &mut *reading;
        if buffers.is_empty() {
            let segments = self.socket.max_receive_segments().max(1);
            *buffers = vec![vec![0; LARGEST.max(segments * 1500)]; BATCH];
        }
        // All packets of the real socket are put on the link. The socket registers its waker when
        // it has no more.
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
                            direction.enter(now, meta.addr, meta.dst_ip, segment);
                        }
                    }
                }
            }
        }
        let now = Instant::now();
        let mut count = 0;
        for (buffer, meta) in bufs.iter_mut().zip(meta.iter_mut()) {
            let Some(packet) = direction.leave(now) else { break };
            // A packet that does not fit is not a QUIC packet of this protocol. It is delivered
            // empty and ignored.
            let len = if packet.bytes.len() <= buffer.len() { packet.bytes.len() } else { 0 };
            buffer[..len].copy_from_slice(&packet.bytes[..len]);
            *meta = RecvMeta { addr: packet.address, len, stride: len, ecn: None, dst_ip: packet.to };
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

    fn max_receive_segments(&self) -> usize {
        self.socket.max_receive_segments()
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    fn may_fragment(&self) -> bool {
        self.socket.may_fragment()
    }
}
