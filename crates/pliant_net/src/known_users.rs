//! The user numbers of keys, so that a user who comes back has the same number, and nobody else has
//! it. A host and a peer both keep them.

use std::collections::{BTreeMap, BTreeSet};

use pliant_stream::UserId;

use crate::transport::Fingerprint;

/// Most keys that are remembered.
const MAX_KNOWN: usize = 4096;

#[derive(Debug, Clone, Copy)]
struct KnownUser {
    user: UserId,
    /// Number of the sighting.
    seen: u64,
}

/// The numbers of the keys that were seen last, and of all that are present.
#[derive(Debug, Default)]
pub(crate) struct KnownUsers {
    users: BTreeMap<Fingerprint, KnownUser>,
    keys: BTreeMap<UserId, Fingerprint>,
    sightings: u64,
    /// The highest number that anybody had.
    highest: UserId,
}

impl KnownUsers {
    /// Takes over the users of an earlier run, who were last seen in this order. If two have the
    /// same number, the later one keeps it.
    pub(crate) fn restored(known: &[(Fingerprint, UserId)]) -> Self {
        let mut restored = Self::default();
        for &(key, user) in known.iter().filter(|(_, user)| *user != UserId::HOST) {
            restored.see(key, user, |_| false);
        }
        restored
    }

    /// Returns the keys and their numbers, in the order in which they were last seen.
    pub(crate) fn in_order(&self) -> Vec<(Fingerprint, UserId)> {
        let mut all: Vec<_> = self.users.iter().map(|(&key, known)| (known.seen, key, known.user)).collect();
        all.sort_unstable();
        all.into_iter().map(|(_, key, user)| (key, user)).collect()
    }

    pub(crate) fn number_of(&self, key: &Fingerprint) -> Option<UserId> {
        self.users.get(key).map(|known| known.user)
    }

    /// Returns whether a number is that of another key.
    pub(crate) fn is_anothers(&self, user: UserId, key: &Fingerprint) -> bool {
        self.keys.get(&user).is_some_and(|owner| owner != key)
    }

    /// Keeps that a key has come or gone, and its number. Of too many keys, those that were seen
    /// longest ago are forgotten, and none that `is_present`.
    pub(crate) fn see(&mut self, key: Fingerprint, user: UserId, is_present: impl Fn(&Fingerprint) -> bool) {
        self.sightings += 1;
        self.highest = self.highest.max(user);
        let before = self.users.insert(key, KnownUser { user, seen: self.sightings });
        if let Some(before) = before.filter(|before| before.user != user) {
            self.keys.remove(&before.user);
        }
        if let Some(other) = self.keys.insert(user, key).filter(|other| *other != key) {
            self.users.remove(&other);
        }
        while self.users.len() > MAX_KNOWN {
            let absent = self.users.iter().filter(|(other, _)| **other != key && !is_present(other));
            let oldest = absent.min_by_key(|(_, known)| known.seen).map(|(&key, known)| (key, known.user));
            let Some((oldest, number)) = oldest else { return };
            self.users.remove(&oldest);
            self.keys.remove(&number);
        }
    }

    /// Returns a number that nobody has who is remembered or `taken`: the one after the highest,
    /// because others may remember users that this app never met. Numbers that are given in order
    /// are those of somebody else only below that. When there is none above, the lowest that is
    /// free.
    pub(crate) fn free_number(&self, taken: &BTreeSet<UserId>) -> Option<UserId> {
        let highest = taken.last().copied().unwrap_or_default().max(self.highest);
        let after = highest.0.checked_add(1).map(UserId);
        let is_free = |user: &UserId| !self.keys.contains_key(user) && !taken.contains(user);
        after.or_else(|| (1..=u16::MAX).map(UserId).find(is_free))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(number: u32) -> Fingerprint {
        let mut bytes = [0; 32];
        bytes[..4].copy_from_slice(&number.to_be_bytes());
        Fingerprint(bytes)
    }

    fn number(of: u32) -> UserId {
        UserId(of as u16)
    }

    #[test]
    fn who_is_present_is_never_forgotten_and_others_by_when_they_were_last_seen() {
        let mut known = KnownUsers::default();
        // The first comes first and stays. The second came second, and has just gone.
        let is_present = |other: &Fingerprint| *other == key(1);
        for user in 1..=MAX_KNOWN as u32 {
            known.see(key(user), number(user), is_present);
        }
        known.see(key(2), number(2), is_present);
        for user in 1..=10 {
            let new = MAX_KNOWN as u32 + user;
            known.see(key(new), number(new), is_present);
        }
        assert_eq!(known.number_of(&key(1)), Some(UserId(1)), "who is present");
        assert_eq!(known.number_of(&key(2)), Some(UserId(2)), "who was here just now");
        assert_eq!(known.number_of(&key(3)), None, "who was seen longest ago");
        assert_eq!(known.number_of(&key(12)), None);
        assert_eq!(known.number_of(&key(13)), Some(UserId(13)));
        assert_eq!(known.in_order().len(), MAX_KNOWN);
        // They are the same after a restart, and in the same order.
        let restored = KnownUsers::restored(&known.in_order());
        assert_eq!(restored.in_order(), known.in_order());
    }

    #[test]
    fn numbers_are_given_to_nobody_else_while_somebody_may_remember_them() {
        let mut known = KnownUsers::restored(&[(key(1), UserId(1)), (key(7), UserId(7))]);
        assert_eq!(known.free_number(&BTreeSet::new()), Some(UserId(8)), "others may have met 2 to 6");
        assert_eq!(known.free_number(&BTreeSet::from([UserId(9)])), Some(UserId(10)));
        assert!(known.is_anothers(UserId(7), &key(1)) && !known.is_anothers(UserId(7), &key(7)));
        // A peer that claims the largest number leaves room for all others.
        known.see(key(9), UserId(u16::MAX), |_| false);
        assert_eq!(known.free_number(&BTreeSet::from([UserId(2)])), Some(UserId(3)));
        // Another number of the same key frees the one before.
        known.see(key(7), UserId(4), |_| false);
        assert!(!known.is_anothers(UserId(7), &key(1)) && known.is_anothers(UserId(4), &key(1)));
    }
}
