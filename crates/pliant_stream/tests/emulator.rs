//! Checks that the network emulator matches its settings.

use std::time::Duration;

use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss, PathTrace, Preset};

const MS: Duration = Duration::from_millis(1);

/// Sends `count` numbered packets `interval` apart and returns (number, arrival) of all that
/// arrive.
fn run(
    config: LinkConfig,
    seed: u64,
    count: u64,
    interval: Duration,
    bytes: usize,
) -> (Vec<(u64, Duration)>, EmulatedLink<u64>) {
    let mut link = EmulatedLink::new(config, seed);
    let mut arrived = Vec::new();
    for k in 0..count {
        let now = interval * k as u32;
        while link.next_wakeup().is_some_and(|t| t <= now) {
            let at = link.next_wakeup().unwrap();
            arrived.push((link.poll(at).unwrap(), at));
        }
        link.send(now, k, bytes);
    }
    while let Some(at) = link.next_wakeup() {
        arrived.push((link.poll(at).unwrap(), at));
    }
    (arrived, link)
}

#[test]
fn random_loss_is_what_it_says() {
    // Binomial: 100,000 packets at 9 % have a standard deviation of 90.5, and four of them are 0.36
    // %.
    let (arrived, link) = run(LinkConfig::preset(Preset::Paper1), 1, 100_000, 25 * MS, 270);
    let loss = 1.0 - arrived.len() as f64 / 1e5;
    assert!((loss - 0.09).abs() < 0.0037, "{loss}");
    assert_eq!(link.counts().lost + arrived.len() as u64, 100_000);
}

#[test]
fn delay_is_the_preset_plus_the_time_on_the_line() {
    let (arrived, _) =
        run(LinkConfig { loss: Loss::None, ..LinkConfig::preset(Preset::Paper1) }, 1, 10, 25 * MS, 222);
    // (222 + 28) bytes at 2 Mb/s take 1 ms.
    for (k, at) in arrived {
        assert_eq!(at, 25 * MS * k as u32 + 98 * MS + MS);
    }
}

#[test]
fn scheduled_losses_hit_exactly_their_packets() {
    let missing = |loss: Loss| {
        let (arrived, _) = run(LinkConfig { loss, ..Default::default() }, 3, 700, 25 * MS, 100);
        (0..700).filter(|k| !arrived.iter().any(|(n, _)| n == k)).collect::<Vec<u64>>()
    };
    assert_eq!(missing(Loss::Burst { first: 140, count: 12 }), (140..152).collect::<Vec<_>>());
    assert_eq!(
        missing(Loss::Every { first: 135, every: 50 }),
        (0..12).map(|k| 135 + 50 * k).collect::<Vec<_>>()
    );
    assert_eq!(missing(Loss::Listed(vec![3, 5])), vec![3, 5]);
    assert_eq!(missing(Loss::Outage { from: 50 * MS, to: 100 * MS }), vec![2, 3]);
}

#[test]
fn gilbert_loss_has_the_mean_and_the_bursts_of_the_reference() {
    // REFERENCES.md: mean loss 9 %, mean burst 4 packets. In continuous time with exponential
    // stays, a bad stay with a mean of 4 intervals contains 4 packets on average, including stays
    // without a packet. Stays with at least one packet contain 1/(1-e^(-1/4)) = 4.52 on average.
    let loss = Loss::gilbert(0.09, 4.0, 25 * MS);
    let (arrived, _) = run(LinkConfig { loss, ..Default::default() }, 11, 400_000, 25 * MS, 100);
    let mut bursts = Vec::new();
    for w in arrived.windows(2) {
        if w[1].0 > w[0].0 + 1 {
            bursts.push((w[1].0 - w[0].0 - 1) as f64);
        }
    }
    let mean_loss = 1.0 - arrived.len() as f64 / 4e5;
    let mean_burst = bursts.iter().sum::<f64>() / bursts.len() as f64;
    assert!((mean_loss - 0.09).abs() < 0.005, "loss {mean_loss}");
    assert!((mean_burst - 4.52).abs() < 0.2, "burst {mean_burst}");
}

#[test]
fn bandwidth_bounds_the_rate_and_the_queue() {
    let config = LinkConfig {
        bits_per_second: Some(1e6),
        queue_bytes: 10_000,
        overhead_bytes: 0,
        ..Default::default()
    };
    // 1,000 bytes every ms are 8 Mb/s into 1 Mb/s. Each packet takes 8 ms, so one in eight passes.
    let (arrived, link) = run(config, 1, 1000, MS, 1000);
    for w in arrived.windows(2) {
        assert!(w[1].1 - w[0].1 >= 8 * MS);
    }
    let longest = arrived.iter().map(|(k, at)| *at - MS * *k as u32).max().unwrap();
    assert!(longest <= 88 * MS, "10,000 bytes wait at most 80 ms, plus its own 8: {longest:?}");
    assert!((arrived.len() as i64 - 135).abs() < 3, "{} and {:?}", arrived.len(), link.counts());
}

#[test]
fn order_copies_and_holding_back() {
    let wifi = LinkConfig { loss: Loss::None, ..LinkConfig::preset(Preset::Wifi) };
    let (arrived, _) = run(wifi, 5, 2000, MS, 100);
    assert!(arrived.windows(2).all(|w| w[0].0 < w[1].0), "keep_order");

    let config = LinkConfig { reorder: 0.1, duplicate: 0.05, delay: 5 * MS, ..Default::default() };
    let (arrived, link) = run(config, 5, 20_000, MS, 100);
    let late = arrived.windows(2).filter(|w| w[1].0 < w[0].0).count();
    assert!(late > 1000, "{late} of about 2,000 held back show as overtaken");
    let copies = link.counts().duplicated as f64 / 20_000.0;
    assert!((copies - 0.05).abs() < 0.0065, "four deviations of 0.15 %: {copies}");
    assert_eq!(arrived.len() as u64, 20_000 + link.counts().duplicated);
}

#[test]
fn same_seed_same_hash_and_other_seed_another() {
    for preset in Preset::ALL {
        let go = |seed| run(LinkConfig::preset(preset), seed, 3000, 3 * MS, 300).1.hash();
        assert_eq!(go(9), go(9), "{}", preset.name());
        if preset != Preset::Paper4 {
            assert_ne!(go(9), go(10), "{}", preset.name());
        }
        assert_eq!(Preset::by_name(preset.name()), Some(preset));
    }
}

#[test]
fn a_trace_is_played_packet_by_packet() {
    let trace = PathTrace::parse("# recorded\n10\nlost\n 20.5 # slow\n").unwrap();
    let (arrived, _) = run(LinkConfig { trace: Some(trace), ..Default::default() }, 1, 4, 100 * MS, 10);
    let want = [(0, 10_000), (2, 220_500), (3, 310_000)];
    assert_eq!(arrived, want.map(|(k, us)| (k, Duration::from_micros(us))));
    assert!(PathTrace::parse("").is_err());
    assert!(PathTrace::parse("NaN").is_err());
    assert!(PathTrace::parse("-1").is_err());
}

#[test]
fn senseless_settings_are_named_and_survived() {
    let bad = LinkConfig {
        loss: Loss::Random(f64::NAN),
        bits_per_second: Some(f64::NAN),
        reorder: 7.0,
        ..Default::default()
    };
    assert!(bad.check().is_err());
    let (arrived, _) = run(bad, 1, 10, MS, 1);
    assert!(!arrived.is_empty());
}

#[test]
fn losses_are_read_from_words() {
    let parse = |words: &str| Loss::parse(words, 5, 25 * MS);
    assert_eq!(parse("none"), Ok(Loss::None));
    assert_eq!(parse("9%"), Ok(Loss::Random(0.09)));
    assert_eq!(parse("burst:12@140"), Ok(Loss::Burst { first: 140, count: 12 }));
    assert_eq!(parse("every:50"), Ok(Loss::Every { first: 135, every: 50 }));
    assert_eq!(parse("gilbert:9%:4"), Ok(Loss::gilbert(0.09, 4.0, 25 * MS)));
    let Ok(Loss::Listed(list)) = parse("random:22@135") else { panic!("22 numbers") };
    assert_eq!(list.len(), 22);
    assert!(list.windows(2).all(|w| w[0] < w[1]) && list.iter().all(|k| (135..635).contains(k)));
    assert_eq!(parse("random:22@135"), Ok(Loss::Listed(list)));
    for bad in [
        "",
        "9",
        "-1%",
        "NaN%",
        "burst:0",
        "burst:x@3",
        "random:501",
        "gilbert:9%",
        "gilbert:9%:0",
        "storm:3",
    ] {
        assert!(parse(bad).is_err(), "{bad}");
    }
}

#[test]
fn words_for_losses_far_off_or_without_end_are_refused_or_say_what_is_done() {
    let parse = |words: &str| Loss::parse(words, 1, 25 * MS);
    for far in ["random:1@18446744073709551615", "burst:3@18446744073709551615", "every:5@281474976710656"] {
        assert!(parse(far).is_err(), "{far}");
    }
    // Use the largest allowed packet number and shift it beyond the range of the type.
    for last in ["random:500@281474976710655", "burst:3@281474976710655", "every:5@281474976710655"] {
        let loss = parse(last).unwrap();
        assert_eq!(loss.check(), Ok(()), "{last}");
        let shifted = loss.shifted(u64::MAX - 5, Duration::MAX);
        let (arrived, _) = run(LinkConfig { loss: shifted, ..Default::default() }, 3, 100, 25 * MS, 100);
        assert_eq!(arrived.len(), 100, "{last}");
    }
    let outage = Loss::Outage { from: MS, to: 2 * MS }.shifted(1, Duration::MAX);
    assert_eq!(outage, Loss::Outage { from: Duration::MAX, to: Duration::MAX });
    // All packets are lost, in either notation.
    for words in ["gilbert:100%:4", "100%"] {
        let loss = parse(words).unwrap();
        assert_eq!(loss.check(), Ok(()), "{words}");
        let (arrived, _) = run(LinkConfig { loss, ..Default::default() }, 3, 2000, 25 * MS, 100);
        assert!(arrived.len() <= 4, "{words}: {} of 2,000 arrive", arrived.len());
    }
    for bad in [Loss::gilbert(f64::NAN, f64::NAN, Duration::MAX), Loss::gilbert(0.5, 1e300, Duration::ZERO)] {
        assert_eq!(bad.check(), Ok(()), "{bad:?}");
    }
}
