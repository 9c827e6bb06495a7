//! A histogram of durations with fixed buckets. It does not allocate, and adding a value costs a
//! few instructions.

/// Durations from 0 to about 17 s in nanoseconds, with 8 buckets per octave. Percentiles are
/// accurate to 12 %.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Histogram {
    counts: [u32; Self::BUCKETS],
    total: u64,
    largest: u64,
}

impl Histogram {
    const PER_OCTAVE: usize = 8;
    /// All durations below `2^SHIFT` ns fall in one octave of equal buckets.
    const SHIFT: u32 = 7;
    const BUCKETS: usize = 28 * Self::PER_OCTAVE;

    /// Adds a duration of `seconds`. Negative values and NaN count as 0. Durations above the range
    /// fall in the last bucket.
    pub fn add(&mut self, seconds: f64) {
        // The saturating cast turns NaN into 0.
        let ns = (seconds * 1e9) as u64;
        let bucket = &mut self.counts[Self::bucket(ns)];
        *bucket = bucket.saturating_add(1);
        self.total += 1;
        self.largest = self.largest.max(ns);
    }

    fn bucket(ns: u64) -> usize {
        let per = Self::PER_OCTAVE as u64;
        if ns < 1 << Self::SHIFT {
            return ((ns * per) >> Self::SHIFT) as usize;
        }
        let octave = ns.ilog2();
        let within = (ns >> (octave - 3)) & (per - 1);
        let index = (octave - Self::SHIFT + 1) as usize * Self::PER_OCTAVE + within as usize;
        index.min(Self::BUCKETS - 1)
    }

    /// Returns the lower end of a bucket, ns.
    fn floor(bucket: usize) -> u64 {
        let (octave, within) = (bucket / Self::PER_OCTAVE, (bucket % Self::PER_OCTAVE) as u64);
        if octave == 0 {
            (within << Self::SHIFT) / Self::PER_OCTAVE as u64
        } else {
            (8 + within) << (octave as u32 + Self::SHIFT - 1 - 3)
        }
    }

    /// Returns the time that the part `p` (0 to 1) of all values does not exceed, s. The result is
    /// the upper end of its bucket, but never above the largest value.
    pub fn percentile(&self, p: f64) -> f64 {
        let wanted = (p.clamp(0.0, 1.0) * self.total as f64).ceil() as u64;
        let mut seen = 0u64;
        for (i, &n) in self.counts.iter().enumerate() {
            seen += u64::from(n);
            if seen >= wanted.max(1) {
                return Self::floor(i + 1).min(self.largest) as f64 * 1e-9;
            }
        }
        self.largest as f64 * 1e-9
    }

    /// Returns the number of values.
    pub fn count(&self) -> u64 {
        self.total
    }

    /// Returns the largest value, s.
    pub fn largest(&self) -> f64 {
        self.largest as f64 * 1e-9
    }
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: [0; Self::BUCKETS], total: 0, largest: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_right_to_a_bucket() {
        let mut h = Histogram::default();
        for us in 1..=10_000 {
            h.add(f64::from(us) * 1e-6);
        }
        for (p, want) in [(0.5, 5e-3), (0.99, 9.9e-3), (0.999, 9.99e-3), (0.01, 1e-4)] {
            let got = h.percentile(p);
            assert!(got >= want * 0.999 && got <= want * 1.13, "{p}: {got} for {want}");
        }
        assert!((h.percentile(1.0) - 0.01).abs() < 1e-9);
        // The floor of every bucket lies in this bucket, and the floors ascend.
        for b in 1..Histogram::BUCKETS - 1 {
            assert_eq!(Histogram::bucket(Histogram::floor(b)), b);
            assert!(Histogram::floor(b) > Histogram::floor(b - 1));
        }
        h.add(f64::NAN);
        h.add(-1.0);
        h.add(1e9);
        assert_eq!(h.count(), 10_003);
    }
}
