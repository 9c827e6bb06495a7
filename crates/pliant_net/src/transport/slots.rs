//! The slots at a host's socket: who may take one, and who makes room for a newcomer.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex};

use bevy::platform::time::Instant;
use tokio::sync::Notify;

use super::config::Limits;
use super::queue::lock;

/// Most addresses whose arrivals are counted.
const MAX_ADDRESSES: usize = 4096;

/// The connections and handshakes of a host.
///
/// A connection that has sent a message after its token is present, and keeps its slot. All others
/// are silent: when there is no room, the oldest of them makes room for a newcomer. Arrivals are
/// counted by address, so that nobody can make others leave again and again.
#[derive(Debug, Default)]
pub(super) struct Slots {
    addresses: BTreeMap<IpAddr, Arrivals>,
    /// By number, so that the oldest comes first.
    taken: BTreeMap<u64, Taken>,
    next: u64,
}

#[derive(Debug)]
struct Arrivals {
    /// How many more may arrive at the time `at`.
    left: f64,
    at: Instant,
    slots: usize,
}

#[derive(Debug)]
struct Taken {
    address: IpAddr,
    present: bool,
    leave: Arc<Notify>,
}

/// Returns what counts as one address: an IPv4 address, or a network of 64 bits of IPv6, which is
/// the least that one customer is given.
fn network_of(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => IpAddr::V6(Ipv6Addr::from_bits(v6.to_bits() & !u128::from(u64::MAX))),
        v4 => v4,
    }
}

impl Slots {
    fn take(&mut self, limits: &Limits, now: Instant, address: IpAddr) -> Option<(u64, Arc<Notify>)> {
        let (address, most) = (network_of(address), limits.per_address.max(1));
        // All that there is room for may come twice at once, and then twice in four seconds.
        let (burst, rate) = (2.0 * most as f64, 0.5 * most as f64);
        self.forget(now, burst, rate);
        let arrivals = self.addresses.entry(address).or_insert(Arrivals { left: burst, at: now, slots: 0 });
        arrivals.left = arrivals.left_at(now, burst, rate);
        arrivals.at = now;
        if arrivals.left < 1.0 {
            return None;
        }
        arrivals.left -= 1.0;
        let is_full = arrivals.slots >= most;
        if is_full {
            self.make_room(address)?;
        }
        if self.taken.len() >= limits.peers {
            let most_silent = self.with_most_silent()?;
            self.make_room(most_silent)?;
        }
        self.addresses.get_mut(&address)?.slots += 1;
        self.next += 1;
        let leave = Arc::new(Notify::new());
        self.taken.insert(self.next, Taken { address, present: false, leave: Arc::clone(&leave) });
        Some((self.next, leave))
    }

    /// Returns the address with the most silent connections.
    fn with_most_silent(&self) -> Option<IpAddr> {
        let mut silent = BTreeMap::<IpAddr, usize>::new();
        for taken in self.taken.values().filter(|taken| !taken.present) {
            *silent.entry(taken.address).or_default() += 1;
        }
        silent.into_iter().max_by_key(|&(_, count)| count).map(|(address, _)| address)
    }

    /// Makes the oldest silent connection of an address leave.
    fn make_room(&mut self, address: IpAddr) -> Option<()> {
        let silent = |(_, taken): &(&u64, &Taken)| taken.address == address && !taken.present;
        let oldest = self.taken.iter().find(silent).map(|(&id, _)| id)?;
        self.taken.get(&oldest)?.leave.notify_one();
        self.free(oldest);
        Some(())
    }

    fn free(&mut self, id: u64) {
        let Some(taken) = self.taken.remove(&id) else { return };
        if let Some(arrivals) = self.addresses.get_mut(&taken.address) {
            arrivals.slots -= 1;
        }
    }

    /// Forgets addresses that have not come for a while, or that have no slot.
    fn forget(&mut self, now: Instant, burst: f64, rate: f64) {
        if self.addresses.len() < MAX_ADDRESSES {
            return;
        }
        self.addresses.retain(|_, a| a.slots > 0 || a.left_at(now, burst, rate) < burst);
        while self.addresses.len() >= MAX_ADDRESSES {
            let idle = self.addresses.iter().filter(|(_, arrivals)| arrivals.slots == 0);
            let Some(oldest) = idle.min_by_key(|(_, arrivals)| arrivals.at).map(|(&address, _)| address)
            else {
                return;
            };
            self.addresses.remove(&oldest);
        }
    }
}

impl Arrivals {
    fn left_at(&self, now: Instant, burst: f64, rate: f64) -> f64 {
        (self.left + now.saturating_duration_since(self.at).as_secs_f64() * rate).min(burst)
    }
}

/// A slot, which is free again when this value is dropped.
#[derive(Debug)]
pub(super) struct Reservation {
    slots: Arc<Mutex<Slots>>,
    id: u64,
    leave: Arc<Notify>,
}

impl Reservation {
    /// Takes a slot for an arrival from an address. `None`: there is none.
    pub(super) fn take(slots: &Arc<Mutex<Slots>>, limits: &Limits, address: IpAddr) -> Option<Self> {
        let (id, leave) = lock(slots).take(limits, Instant::now(), address)?;
        Some(Self { slots: Arc::clone(slots), id, leave })
    }

    /// Keeps the slot from now on.
    pub(super) fn keep(&self) {
        if let Some(taken) = lock(&self.slots).taken.get_mut(&self.id) {
            taken.present = true;
        }
    }

    /// Is notified when the connection must make room.
    pub(super) fn leaving(&self) -> Arc<Notify> {
        Arc::clone(&self.leave)
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        lock(&self.slots).free(self.id);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn silent_ones_make_room_and_present_ones_do_not() {
        let limits = Limits { peers: 4, per_address: 3, ..Limits::host() };
        let (mut slots, now) = (Slots::default(), Instant::now());
        let (here, there) = (address("192.0.2.1"), address("192.0.2.2"));
        let mut take = |from| slots.take(&limits, now, from).map(|(id, _)| id);
        let first: Vec<u64> = (0..3).map(|_| take(here).unwrap()).collect();
        assert!(take(there).is_some());
        // Full, and the silent ones of the address with the most of them make room.
        assert!(take(there).is_some());
        assert!(!slots.taken.contains_key(&first[0]) && slots.taken.len() == 4);
        for taken in slots.taken.values_mut() {
            taken.present = true;
        }
        assert!(slots.take(&limits, now, here).is_none(), "all are present");
        slots.free(first[1]);
        assert!(slots.take(&limits, now, here).is_some());
        // Nor does one that is present make room for another of its own address.
        let mut slots = Slots::default();
        for _ in 0..3 {
            let (id, _) = slots.take(&limits, now, here).unwrap();
            slots.taken.get_mut(&id).unwrap().present = true;
        }
        assert!(slots.take(&limits, now, here).is_none(), "all of its address are present");
    }

    #[test]
    fn arrivals_are_counted_by_address_and_by_network() {
        let limits = Limits { per_address: 8, ..Limits::host() };
        let (mut slots, now) = (Slots::default(), Instant::now());
        let come = |slots: &mut Slots, from: &str, now| {
            (0..100).filter(|_| slots.take(&limits, now, address(from)).is_some()).count()
        };
        assert_eq!(come(&mut slots, "192.0.2.1", now), 16);
        assert_eq!(come(&mut slots, "::ffff:192.0.2.1", now), 0, "the same address");
        assert_eq!(come(&mut slots, "192.0.2.2", now), 16);
        assert_eq!(come(&mut slots, "2001:db8::1", now), 16);
        assert_eq!(come(&mut slots, "2001:db8::ffff:1:2:3", now), 0, "the same network");
        assert_eq!(come(&mut slots, "2001:db8:0:1::1", now), 16);
        assert_eq!(come(&mut slots, "192.0.2.1", now + Duration::from_secs(1)), 4);
        assert_eq!(slots.taken.len(), 4 * 8, "and no address has more slots than it may");
        // The number of addresses that are remembered is bounded.
        for k in 0..10_000_u128 {
            let from = IpAddr::V6(Ipv6Addr::from_bits((0x2001_0db9 << 96) + (k << 64)));
            if let Some((id, _)) = slots.take(&limits, now, from) {
                slots.free(id);
            }
        }
        assert!(slots.addresses.len() <= MAX_ADDRESSES, "{}", slots.addresses.len());
    }
}
