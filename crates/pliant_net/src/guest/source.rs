//! Source of a guest's session: a host over a carrier, or a recording of one.

use std::sync::Arc;
use std::time::Duration;

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_modal::ModalModel;
use pliant_stream::{Channel, DisconnectReason, Output, PeerId};
use tracing::debug;

use crate::recording::{SessionRecord, SessionRecorder, SessionRecording};
use crate::transport::{Carrier, Endpoint, Event, Fingerprint, PeerStats, Role, quic};

/// The guest's transport source.
pub(crate) enum Source {
    Live { carrier: Box<dyn Carrier>, recorder: Option<SessionRecorder> },
    Replay { recording: SessionRecording, max_datagram: usize, over: bool },
}

/// A received event, with its time of arrival where the session needs it.
pub(crate) enum Came {
    Connected { role: Role },
    Datagram { at: Duration, bytes: Bytes },
    Message { bytes: Bytes },
    Closed { reason: DisconnectReason },
}

impl Source {
    pub(crate) fn replay(recording: SessionRecording) -> Self {
        Self::Replay { recording, max_datagram: 0, over: false }
    }

    /// Returns the next event that arrived by `now`. `now` and the event's time count from `began`.
    pub(crate) fn poll(&mut self, began: Instant, now: Duration) -> Option<Came> {
        match self {
            Self::Live { carrier, recorder } => {
                let (came, at, record) = match carrier.poll()? {
                    Event::Connected { peer, role, .. } => {
                        let most = carrier.max_datagram_size(peer).unwrap_or(0);
                        let max_datagram = u16::try_from(most).unwrap_or(u16::MAX);
                        (Came::Connected { role }, now, SessionRecord::Connected { role, max_datagram })
                    }
                    Event::Datagram { at, bytes, .. } => {
                        let at = at.saturating_duration_since(began);
                        (Came::Datagram { at, bytes: bytes.clone() }, at, SessionRecord::Datagram(bytes))
                    }
                    Event::Message { bytes, .. } => {
                        (Came::Message { bytes: bytes.clone() }, now, SessionRecord::Message(bytes))
                    }
                    Event::Closed { reason, .. } => {
                        (Came::Closed { reason }, now, SessionRecord::Closed(reason))
                    }
                };
                if let Some(recorder) = recorder {
                    recorder.put(at, &record);
                }
                Some(came)
            }
            Self::Replay { recording, max_datagram, over } => {
                let Some((at, record)) = recording.poll(now) else {
                    let ends = recording.is_over() && !std::mem::replace(over, true);
                    return ends.then_some(Came::Closed { reason: DisconnectReason::RecordingOver });
                };
                Some(match record {
                    SessionRecord::Connected { role, max_datagram: most } => {
                        *max_datagram = usize::from(most);
                        Came::Connected { role }
                    }
                    SessionRecord::Datagram(bytes) => Came::Datagram { at, bytes },
                    SessionRecord::Message(bytes) => Came::Message { bytes },
                    SessionRecord::Closed(reason) => {
                        // The recording goes on after a close if the recorded guest joined again.
                        *over |= recording.is_over();
                        Came::Closed { reason }
                    }
                    // [`SessionRecording::open`] has already read the models.
                    SessionRecord::Model(_) => return self.poll(began, now),
                })
            }
        }
    }

    pub(crate) fn send(&self, output: Output) {
        let Self::Live { carrier, .. } = self else { return };
        // A host that does not read these few messages is lost, which the idle timeout will report.
        let sent = match output.channel {
            Channel::Datagram => carrier.send_datagram(PeerId::HOST, Bytes::from_owner(output.bytes)),
            Channel::Message => carrier.send_message(PeerId::HOST, Bytes::from_owner(output.bytes)),
        };
        if let Err(error) = sent {
            debug!("not sent to the host: {error}");
        }
    }

    /// Adds a cached model that the session uses to the recording, because the host never sends it.
    pub(crate) fn keep_model(&mut self, now: Duration, model: &Arc<ModalModel>) {
        if let Self::Live { recorder: Some(recorder), .. } = self {
            recorder.put_model(now, model);
        }
    }

    pub(crate) fn is_replay(&self) -> bool {
        matches!(self, Self::Replay { .. })
    }

    /// Returns the own key. A recording has none.
    pub(crate) fn fingerprint(&self) -> Option<Fingerprint> {
        match self {
            Self::Live { carrier, .. } => Some(carrier.fingerprint()),
            Self::Replay { .. } => None,
        }
    }

    pub(crate) fn endpoint(&self) -> Option<&Endpoint> {
        match self {
            Self::Live { carrier, .. } => quic(&**carrier),
            Self::Replay { .. } => None,
        }
    }

    pub(crate) fn max_datagram_size(&self) -> Option<usize> {
        match self {
            Self::Live { carrier, .. } => carrier.max_datagram_size(PeerId::HOST),
            Self::Replay { max_datagram, .. } => Some(*max_datagram),
        }
    }

    /// Returns the connection's metrics. A recording has none of its own.
    pub(crate) fn stats(&self) -> Option<PeerStats> {
        match self {
            Self::Live { carrier, .. } => carrier.stats(PeerId::HOST),
            Self::Replay { over, .. } => (!over).then(PeerStats::default),
        }
    }

    pub(crate) fn close(&self) {
        if let Self::Live { carrier, .. } = self {
            carrier.close(PeerId::HOST, DisconnectReason::Left);
        }
    }

    /// Ends the connection for good, and leaves its port.
    pub(crate) fn end(&self) {
        if let Self::Live { carrier, .. } = self {
            carrier.end();
        }
    }

    pub(crate) fn rejoin(&self) {
        if let Self::Live { carrier, .. } = self {
            carrier.rejoin();
        }
    }
}
