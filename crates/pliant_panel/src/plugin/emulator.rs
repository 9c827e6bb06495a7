//! Conversion between the emulator's knobs and links.

use std::time::Duration;

use pliant_net::{
    Emulation,
    emulator::{LinkConfig, Loss, Preset},
};

use crate::network::EmulatorView;

/// Index of the preset that is shown if the links are not a preset.
const OTHER: usize = Preset::ALL.len() + 1;

/// Seed of the links that the panel adds. Settings that change while the seed stays the same apply
/// to the same link, also for packets in flight.
const SEED: u64 = 1;

/// Returns the knobs for the links in use.
///
/// `other` shows them as another network even if their settings are those of a preset.
pub(super) fn view_of(emulation: Option<&Emulation>, other: bool) -> EmulatorView {
    let mut presets = vec!["none".to_owned()];
    presets.extend(Preset::ALL.iter().map(|preset| preset.name().to_owned()));
    presets.push("other".into());
    let Some(Emulation { outgoing, incoming, seed }) = emulation else {
        return EmulatorView { presets, ..EmulatorView::default() };
    };
    let is = |preset: &Preset| {
        let link = LinkConfig::preset(*preset);
        *outgoing == link && *incoming == link
    };
    let known = Preset::ALL.iter().position(is).filter(|_| !other);
    let mean = |of: fn(&LinkConfig) -> f64| 0.5 * (of(outgoing) + of(incoming));
    EmulatorView {
        presets,
        preset: known.map_or(OTHER, |index| index + 1),
        recorded: outgoing.trace.is_some() || incoming.trace.is_some(),
        loss: 100.0 * mean(|link| share(&link.loss)),
        round_trip_ms: (outgoing.delay + incoming.delay).as_secs_f64() * 1e3,
        jitter_ms: mean(|link| link.jitter.as_secs_f64() * 1e3),
        burst_ms: mean(|link| burst(&link.loss).as_secs_f64() * 1e3),
        rate_mbit: mean(|link| link.bits_per_second.unwrap_or(0.0) * 1e-6),
        queue_kib: mean(|link| link.queue_bytes as f64 / 1024.0),
        reordered: 100.0 * mean(|link| link.reorder),
        held_back_ms: mean(|link| link.reorder_by.as_secs_f64() * 1e3),
        duplicated: 100.0 * mean(|link| link.duplicate),
        keep_order: outgoing.keep_order && incoming.keep_order,
        seed: *seed,
    }
}

/// Returns the links for knobs that were moved from `before` to `wanted`, based on those in use.
pub(super) fn emulation_of(
    before: &EmulatorView,
    wanted: &EmulatorView,
    now: Option<&Emulation>,
) -> Option<Emulation> {
    let seed = now.map_or(SEED, |now| now.seed);
    if wanted.preset != before.preset {
        return match wanted.preset {
            0 => None,
            // The new network starts as the network in use, or as a perfect network if there is
            // none.
            OTHER => Some(now.cloned().unwrap_or_else(|| Emulation {
                outgoing: LinkConfig::default(),
                incoming: LinkConfig::default(),
                seed,
            })),
            index => Preset::ALL.get(index - 1).map(|&preset| Emulation::preset(preset, seed)),
        };
    }
    let mut new = now?.clone();
    new.seed = wanted.seed;
    // Only the moved knobs are applied, to both directions, because a knob has one value for both.
    let moved = |of: fn(&EmulatorView) -> f64| (of(wanted) != of(before)).then(|| of(wanted));
    for link in [&mut new.outgoing, &mut new.incoming] {
        if let Some(percent) = moved(|view| view.loss) {
            link.loss = with_share(&link.loss, percent / 100.0);
        }
        if let Some(ms) = moved(|view| view.burst_ms) {
            link.loss = with_bursts(share(&link.loss), milliseconds(ms));
        }
        if let Some(ms) = moved(|view| view.round_trip_ms) {
            link.delay = milliseconds(0.5 * ms);
        }
        if let Some(ms) = moved(|view| view.jitter_ms) {
            link.jitter = milliseconds(ms);
        }
        if let Some(mbit) = moved(|view| view.rate_mbit) {
            link.bits_per_second = (mbit > 0.0).then(|| (mbit * 1e6).clamp(1.0, 1e15));
        }
        if let Some(kib) = moved(|view| view.queue_kib) {
            link.queue_bytes = (kib.clamp(0.0, 1e6) * 1024.0) as usize;
        }
        if let Some(percent) = moved(|view| view.reordered) {
            link.reorder = (percent / 100.0).clamp(0.0, 1.0);
        }
        if let Some(ms) = moved(|view| view.held_back_ms) {
            link.reorder_by = milliseconds(ms);
        }
        if let Some(percent) = moved(|view| view.duplicated) {
            link.duplicate = (percent / 100.0).clamp(0.0, 1.0);
        }
        if wanted.keep_order != before.keep_order {
            link.keep_order = wanted.keep_order;
        }
    }
    Some(new)
}

fn milliseconds(ms: f64) -> Duration {
    Duration::try_from_secs_f64(ms.clamp(0.0, 1e5) * 1e-3).unwrap_or_default()
}

/// Returns the share of packets that are lost in the long run, 0 to 1. Single events count as no
/// loss.
fn share(loss: &Loss) -> f64 {
    match loss {
        Loss::Random(share) => *share,
        Loss::Every { every, .. } => 1.0 / (*every).max(1) as f64,
        Loss::GilbertElliott { good, bad, loss_good, loss_bad } => {
            let (good, bad) = (good.as_secs_f64(), bad.as_secs_f64());
            let all = good + bad;
            if all > 0.0 { (loss_good * good + loss_bad * bad) / all } else { 0.0 }
        }
        _ => 0.0,
    }
}

/// Returns the mean length of a burst, which is zero for packets that are lost independently.
fn burst(loss: &Loss) -> Duration {
    match loss {
        Loss::GilbertElliott { bad, .. } => *bad,
        _ => Duration::ZERO,
    }
}

/// Returns the same kind of loss with another share. Bursts keep their length and change their
/// frequency, also after the share was zero.
fn with_share(loss: &Loss, share: f64) -> Loss {
    let share = share.clamp(0.0, 1.0);
    match loss {
        Loss::GilbertElliott { bad, .. } if share == 0.0 => {
            Loss::GilbertElliott { good: *bad, bad: *bad, loss_good: 0.0, loss_bad: 0.0 }
        }
        Loss::GilbertElliott { bad, loss_bad, .. } => {
            // The loss in the bad state is kept if possible.
            let loss_bad = if share < *loss_bad { *loss_bad } else { 1.0 };
            in_bursts(share, *bad, loss_bad)
        }
        _ if share == 0.0 => Loss::None,
        _ => Loss::Random(share),
    }
}

/// Returns a loss of `share` in bursts of mean length `bad`, in which everything is lost. Bursts
/// without length lose each packet independently.
fn with_bursts(share: f64, bad: Duration) -> Loss {
    if bad < Duration::from_micros(1) { with_share(&Loss::None, share) } else { in_bursts(share, bad, 1.0) }
}

fn in_bursts(share: f64, bad: Duration, loss_bad: f64) -> Loss {
    if share >= loss_bad || share <= 0.0 {
        return Loss::Random(share.clamp(0.0, 1.0));
    }
    // share = loss_bad bad / (good + bad)
    let good = bad.mul_f64((loss_bad / share - 1.0).clamp(1e-6, 1e9)).max(Duration::from_micros(1));
    Loss::GilbertElliott { good, bad, loss_good: 0.0, loss_bad }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_chosen_shown_and_taken_out_again() {
        let none = view_of(None, false);
        assert_eq!((none.preset, none.presets.len()), (0, Preset::ALL.len() + 2));
        for (index, preset) in Preset::ALL.into_iter().enumerate() {
            assert_eq!(none.presets[index + 1], preset.name());
            let wanted = EmulatorView { preset: index + 1, ..none.clone() };
            let put_in = emulation_of(&none, &wanted, None).unwrap();
            assert_eq!(put_in.outgoing, LinkConfig::preset(preset));
            assert_eq!(put_in.incoming, LinkConfig::preset(preset));
            let shown = view_of(Some(&put_in), false);
            assert_eq!(shown.preset, index + 1);
            let off = EmulatorView { preset: 0, ..shown.clone() };
            assert!(emulation_of(&shown, &off, Some(&put_in)).is_none());
        }
        // The paper's first network, and bursts of 20 ms with a loss of 1 % in total.
        let paper = view_of(Some(&Emulation::preset(Preset::Paper1, 1)), false);
        assert!((paper.loss - 9.0).abs() < 1e-12 && (paper.round_trip_ms - 196.0).abs() < 1e-9);
        let wifi = view_of(Some(&Emulation::preset(Preset::Wifi, 1)), false);
        assert!((wifi.loss - 1.0).abs() < 1e-6 && (wifi.jitter_ms - 3.0).abs() < 1e-9, "{wifi:?}");
    }

    #[test]
    fn loss_delay_and_jitter_are_moved_one_by_one_and_the_rest_stays() {
        let running = Emulation::preset(Preset::Wifi, 7);
        let before = view_of(Some(&running), false);
        let moved = |change: fn(&mut EmulatorView)| {
            let mut wanted = before.clone();
            change(&mut wanted);
            emulation_of(&before, &wanted, Some(&running)).unwrap()
        };
        let lossy = moved(|view| view.loss = 10.0);
        let shown = view_of(Some(&lossy), false);
        assert!((shown.loss - 10.0).abs() < 1e-6 && shown.preset == OTHER, "{shown:?}");
        assert_eq!(
            (lossy.seed, lossy.outgoing.jitter, lossy.outgoing.delay),
            (7, running.outgoing.jitter, running.outgoing.delay)
        );
        assert!(
            matches!(lossy.outgoing.loss, Loss::GilbertElliott { bad, .. } if bad == Duration::from_millis(20))
        );
        let far = moved(|view| view.round_trip_ms = 300.0);
        assert_eq!(
            (far.outgoing.delay, far.incoming.delay),
            (Duration::from_millis(150), Duration::from_millis(150))
        );
        assert_eq!(far.outgoing.loss, running.outgoing.loss);
        let uneven = moved(|view| view.jitter_ms = 12.0);
        assert_eq!(uneven.incoming.jitter, Duration::from_millis(12));
        let clean = moved(|view| view.loss = 0.0);
        assert_eq!(
            (share(&clean.incoming.loss), burst(&clean.incoming.loss)),
            (0.0, Duration::from_millis(20))
        );
        let again = EmulatorView { loss: 2.0, ..view_of(Some(&clean), false) };
        let again = emulation_of(&view_of(Some(&clean), false), &again, Some(&clean)).unwrap();
        assert!((share(&again.incoming.loss) - 0.02).abs() < 1e-6, "in bursts as before: {again:?}");
        assert_eq!(burst(&again.incoming.loss), Duration::from_millis(20));
        for link in [&lossy, &far, &uneven, &clean, &again].map(|emulation| &emulation.outgoing) {
            link.check().unwrap();
        }
    }

    #[test]
    fn every_finer_knob_moves_its_own_trait_both_ways_and_no_other() {
        let running = Emulation::preset(Preset::Wifi, 7);
        let before = view_of(Some(&running), true);
        assert_eq!((before.preset, before.other()), (OTHER, true), "wifi, called another network");
        let plain = |change: fn(&mut LinkConfig)| {
            let mut wanted = running.clone();
            change(&mut wanted.outgoing);
            change(&mut wanted.incoming);
            wanted
        };
        type Moves = (fn(&mut EmulatorView), Emulation);
        let moves: [Moves; 8] = [
            (|view| view.rate_mbit = 2.0, plain(|link| link.bits_per_second = Some(2e6))),
            (|view| view.rate_mbit = 0.0, plain(|link| link.bits_per_second = None)),
            (|view| view.queue_kib = 16.0, plain(|link| link.queue_bytes = 16 * 1024)),
            (|view| view.reordered = 25.0, plain(|link| link.reorder = 0.25)),
            (|view| view.held_back_ms = 40.0, plain(|link| link.reorder_by = Duration::from_millis(40))),
            (|view| view.duplicated = 5.0, plain(|link| link.duplicate = 0.05)),
            (|view| view.keep_order = false, plain(|link| link.keep_order = false)),
            (|view| view.seed = 8, Emulation { seed: 8, ..running.clone() }),
        ];
        for (change, expected) in moves {
            let mut wanted = before.clone();
            change(&mut wanted);
            let moved = emulation_of(&before, &wanted, Some(&running)).unwrap();
            assert_eq!(moved, expected);
            moved.outgoing.check().unwrap();
            // The view shows the requested values.
            assert_eq!(view_of(Some(&moved), true), wanted);
        }
        let wanted = EmulatorView { burst_ms: 100.0, ..before.clone() };
        let long = emulation_of(&before, &wanted, Some(&running)).unwrap();
        // In the Gilbert model, bad / (good + bad) is the share, 1 %.
        let Loss::GilbertElliott { good, bad, .. } = long.outgoing.loss else { panic!("{long:?}") };
        assert_eq!(bad, Duration::from_millis(100));
        assert!((good.as_secs_f64() - 9.9).abs() < 1e-6, "{good:?}");
        let wanted = EmulatorView { burst_ms: 0.0, ..before.clone() };
        let alone = emulation_of(&before, &wanted, Some(&running)).unwrap();
        assert!(matches!(alone.incoming.loss, Loss::Random(share) if (share - 0.01).abs() < 1e-9));
    }

    #[test]
    fn another_network_begins_as_the_one_in_use() {
        let paper = Emulation::preset(Preset::Paper1, 3);
        let before = view_of(Some(&paper), false);
        assert!(!before.other());
        let wanted = EmulatorView { preset: OTHER, ..before.clone() };
        assert_eq!(emulation_of(&before, &wanted, Some(&paper)), Some(paper.clone()));
        let none = view_of(None, false);
        let wanted = EmulatorView { preset: OTHER, ..none.clone() };
        let perfect = emulation_of(&none, &wanted, None).unwrap();
        assert_eq!((perfect.outgoing, perfect.incoming), (LinkConfig::default(), LinkConfig::default()));
    }
}
