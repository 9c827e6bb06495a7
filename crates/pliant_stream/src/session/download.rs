//! Assembles models that arrive in pieces.

use std::sync::Arc;

use pliant_modal::ModalModel;

use super::DisconnectReason;
use super::guest::GuestSession;
use super::guest_config::GuestEvent;

#[derive(Debug, Default)]
pub(super) struct Download {
    pub(super) bytes: Vec<u8>,
    pub(super) total: u64,
}

impl GuestSession {
    pub(super) fn model_chunk(&mut self, hash: [u8; 32], offset: u64, total: u64, bytes: &[u8]) {
        if self.models.contains_key(&hash) || self.being_read.contains(&hash) {
            return;
        }
        // The body may be gone already. The host counts a model as known to the guest once it has
        // sent it, so the download still completes.
        let wanted = self.announced.contains(&hash);
        let download = self.downloads.entry(hash).or_default();
        let received = download.bytes.len() as u64;
        let fits = wanted
            && total >= 1
            && offset == received
            && (received == 0 || download.total == total)
            && received + bytes.len() as u64 <= total
            && !bytes.is_empty();
        if !fits {
            return self.break_off(DisconnectReason::Protocol);
        }
        // The whole size of a model counts from its first piece on, so that no two unfinished
        // models share the same room.
        let more = if received == 0 { total } else { 0 };
        if more > self.config.model_bytes.saturating_sub(self.model_bytes) {
            return self.break_off(DisconnectReason::Full);
        }
        self.model_bytes += more;
        download.total = total;
        // The buffer grows with the received bytes, so a false total reserves no memory.
        download.bytes.extend_from_slice(bytes);
        let received = download.bytes.len() as u64;
        self.event(GuestEvent::ModelProgress { hash, received, total });
        if received < total {
            return;
        }
        let Some(done) = self.downloads.remove(&hash) else { return };
        if self.config.models_apart {
            self.being_read.insert(hash);
            return self.event(GuestEvent::ModelCame { hash, bytes: done.bytes.into() });
        }
        let read = ModalModel::from_bytes(&done.bytes).ok().map(Arc::new);
        self.take_model(hash, read);
    }

    /// Returns a decoded model after a [`GuestEvent::ModelCame`].
    ///
    /// `None` says that the bytes are not a valid model. `None`, or a model with another hash than
    /// the announced one, ends the session. The call has no effect for a model that the session
    /// does not wait for.
    pub fn give_model(&mut self, hash: [u8; 32], model: Option<Arc<ModalModel>>) {
        if self.being_read.remove(&hash) && !self.is_closed() {
            self.take_model(hash, model);
        }
    }

    fn take_model(&mut self, hash: [u8; 32], model: Option<Arc<ModalModel>>) {
        match model {
            Some(model) if model.hash().0 == hash => {
                self.models.insert(hash, model.clone());
                let mut ready = Vec::new();
                for view in self.bodies.values_mut().filter(|b| b.info().hash == hash) {
                    view.set_model(model.clone());
                    if view.is_ready() {
                        ready.push(view.id());
                    }
                }
                for body in ready {
                    self.event(GuestEvent::BodyReady { body, model: model.clone() });
                }
            }
            _ => self.break_off(DisconnectReason::Protocol),
        }
    }
}
