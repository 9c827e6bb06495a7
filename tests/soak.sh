#!/bin/sh
# A soak: a server and three guests over loopback, two of which hold the body, for an hour.
#
#   tests/soak.sh [--hours HOURS]
#
# Prints the memory, the open handles and the ticks a second of the server and of the guests'
# process each tenth, and ends with 1 where memory or handles grow by more than a tenth after the
# first tenth, where the ticks of the server drift by more than a thousandth from its clock, or
# where a process ends with an error. Binaries: those of BIN, or built by cargo. Ends with 77
# (skipped) where a tool is missing.
set -u
cd "$(dirname "$0")/.."
skip() { echo "skipped: $1"; exit 77; }
[ -r /proc/self/statm ] || skip "needs Linux"
env --default-signal=INT true 2>/dev/null || skip "no env of GNU coreutils"
hours=1
[ "${1:-}" = --hours ] && hours=${2:?how many hours}
seconds=$(awk "BEGIN { print int(3600 * $hours) }")
if [ -z "${BIN:-}" ]; then
    cargo build --release -p pliant_examples --no-default-features --features net \
        --example dedicated_server --example join || exit 2
    BIN=$(cargo metadata --format-version 1 --no-deps |
        sed 's/.*"target_directory":"\([^"]*\)".*/\1/')/release/examples
fi
work=$(mktemp -d)
pids=""
trap 'for pid in $pids; do kill "$pid" 2>/dev/null; done; rm -rf "$work"' EXIT
trap 'exit 130' INT TERM HUP
: >"$work/server.log"
env --default-signal=INT "$BIN/dedicated_server" --bind 127.0.0.1:0 --key "$work/key" --play \
    >"$work/server.log" 2>&1 &
server=$!
pids="$pids $server"
while kill -0 $server 2>/dev/null && ! grep -q "to hold" "$work/server.log"; do sleep 0.1; done
invite=$(sed -n 's/^to hold:  //p' "$work/server.log" | head -1)
env --default-signal=INT "$BIN/join" "$invite" --bots 3 --holders 2 --cached \
    --seconds $((seconds + 60)) >"$work/bots.log" 2>&1 &
bots=$!
pids="$pids $bots"
sleep 15
look() { # PID: memory, kB, and open handles
    echo "$(awk '/^VmRSS/ { print $2 }' /proc/$1/status) $(ls /proc/$1/fd | wc -l)"
}
printf '%10s %12s %8s %12s %8s\n' s "server, kB" handles "guests, kB" handles
for tenth in $(seq 0 10); do
    [ "$tenth" -gt 0 ] && sleep "$(awk "BEGIN { print $seconds / 10 }")"
    kill -0 $server 2>/dev/null && kill -0 $bots 2>/dev/null || { echo "a process is gone"; exit 1; }
    line="$(awk "BEGIN { print $seconds * $tenth / 10 }") $(look $server) $(look $bots)"
    echo "$line" >>"$work/looks"
    printf '%10s %12s %8s %12s %8s\n' $line
done
kill -INT $bots
wait $bots || { echo "the guests ended with $?: $(tail -1 "$work/bots.log")"; exit 1; }
kill -INT $server
wait $server || { echo "the server ended with $?"; exit 1; }
awk -v bad=0 '
    FNR == NR { if (NR == 2) split($0, first); split($0, last); next }
    # The first and the last window have fewer users.
    /users, / { n++; sum += substr($0, index($0, "users, ") + 7) + 0 }
    END {
        for (k = 2; k <= 5; k++)
            if (last[k] > 1.1 * first[k] + (k % 2 ? 2 : 0)) { print "grows: column " k; bad = 1 }
        rate = sum / n
        printf "%.3f ticks/s on average of %d windows\n", rate, n
        if (rate < 0.999 * 40 || rate > 1.001 * 40) { print "drifts"; bad = 1 }
        exit bad
    }' "$work/looks" "$work/server.log"
