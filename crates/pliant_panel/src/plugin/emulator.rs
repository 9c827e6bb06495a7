//! From the emulator's knobs to links, and back.

use std::time::Duration;

use pliant_net::{
    Emulation,
    emulator::{LinkConfig, Loss, Preset},
};

use crate::network::EmulatorView;

/// Shown where the links are none of the presets.
const OTHER: usize = Preset::ALL.len() + 1;

/// The seed of links that the panel puts in: one seed is one link, whose settings change under the packets that are on their way.
const SEED: u64 = 1;

/// What the knobs show of the links in use.
pub(super) fn view_of(emulation: Option<&Emulation>) -> EmulatorView {
    let mut presets = vec!["none".to_owned()];
    presets.extend(Preset::ALL.iter().map(|preset| preset.name().to_owned()));
    presets.push("other".into());
    let Some(Emulation { outgoing, incoming, .. }) = emulation else {
        return EmulatorView { presets, ..EmulatorView::default() };
    };
    let is = |preset: &Preset| {
        let link = LinkConfig::preset(*preset);
        *outgoing == link && *incoming == link
    };
    EmulatorView {
        presets,
        preset: Preset::ALL.iter().position(is).map_or(OTHER, |index| index + 1),
        loss: 50.0 * (share(&outgoing.loss) + share(&incoming.loss)),
        round_trip_ms: (outgoing.delay + incoming.delay).as_secs_f64() * 1e3,
        jitter_ms: 0.5 * (outgoing.jitter + incoming.jitter).as_secs_f64() * 1e3,
    }
}

/// The links that the knobs, moved from `before` to `wanted`, ask for in place of those in use.
pub(super) fn emulation_of(
    before: &EmulatorView,
    wanted: &EmulatorView,
    now: Option<&Emulation>,
) -> Option<Emulation> {
    let seed = now.map_or(SEED, |now| now.seed);
    if wanted.preset != before.preset {
        return match wanted.preset {
            0 => None,
            OTHER => Some(now.cloned().unwrap_or_else(|| Emulation {
                outgoing: LinkConfig::default(),
                incoming: LinkConfig::default(),
                seed,
            })),
            index => Preset::ALL.get(index - 1).map(|&preset| Emulation::preset(preset, seed)),
        };
    }
    let mut new = now?.clone();
    for link in [&mut new.outgoing, &mut new.incoming] {
        if wanted.loss != before.loss {
            link.loss = with_share(&link.loss, wanted.loss / 100.0);
        }
        // Both ways alike, as the knob knows of one round trip only.
        if wanted.round_trip_ms != before.round_trip_ms {
            link.delay = milliseconds(0.5 * wanted.round_trip_ms);
        }
        if wanted.jitter_ms != before.jitter_ms {
            link.jitter = milliseconds(wanted.jitter_ms);
        }
    }
    Some(new)
}

fn milliseconds(ms: f64) -> Duration {
    Duration::try_from_secs_f64(ms.clamp(0.0, 1e5) * 1e-3).unwrap_or_default()
}

/// The share of packets that is lost in the long run, 0 to 1; of single events, none.
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

/// The same kind of loss with another share: bursts stay as long as they are and come more or less often.
fn with_share(loss: &Loss, share: f64) -> Loss {
    let share = share.clamp(0.0, 1.0);
    match loss {
        _ if share == 0.0 => Loss::None,
        Loss::GilbertElliott { bad, loss_good: 0.0, loss_bad, .. } if share < *loss_bad => {
            // share = loss_bad bad / (good + bad)
            let good = bad.mul_f64(loss_bad / share - 1.0);
            Loss::GilbertElliott { good, bad: *bad, loss_good: 0.0, loss_bad: *loss_bad }
        }
        _ => Loss::Random(share),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_chosen_shown_and_taken_out_again() {
        let none = view_of(None);
        assert_eq!((none.preset, none.presets.len()), (0, Preset::ALL.len() + 2));
        for (index, preset) in Preset::ALL.into_iter().enumerate() {
            assert_eq!(none.presets[index + 1], preset.name());
            let wanted = EmulatorView { preset: index + 1, ..none.clone() };
            let put_in = emulation_of(&none, &wanted, None).unwrap();
            assert_eq!(put_in.outgoing, LinkConfig::preset(preset));
            assert_eq!(put_in.incoming, LinkConfig::preset(preset));
            let shown = view_of(Some(&put_in));
            assert_eq!(shown.preset, index + 1);
            let off = EmulatorView { preset: 0, ..shown.clone() };
            assert!(emulation_of(&shown, &off, Some(&put_in)).is_none());
        }
        // The paper's first network, and bursts of 20 ms that take 1 % in all.
        let paper = view_of(Some(&Emulation::preset(Preset::Paper1, 1)));
        assert!((paper.loss - 9.0).abs() < 1e-12 && (paper.round_trip_ms - 196.0).abs() < 1e-9);
        let wifi = view_of(Some(&Emulation::preset(Preset::Wifi, 1)));
        assert!((wifi.loss - 1.0).abs() < 1e-6 && (wifi.jitter_ms - 3.0).abs() < 1e-9, "{wifi:?}");
    }

    #[test]
    fn loss_delay_and_jitter_are_moved_one_by_one_and_the_rest_stays() {
        let running = Emulation::preset(Preset::Wifi, 7);
        let before = view_of(Some(&running));
        let moved = |change: fn(&mut EmulatorView)| {
            let mut wanted = before.clone();
            change(&mut wanted);
            emulation_of(&before, &wanted, Some(&running)).unwrap()
        };
        let lossy = moved(|view| view.loss = 10.0);
        let shown = view_of(Some(&lossy));
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
        assert_eq!(moved(|view| view.loss = 0.0).incoming.loss, Loss::None);
        for link in [&lossy, &far, &uneven].map(|emulation| &emulation.outgoing) {
            link.check().unwrap();
        }
    }
}
