#!/bin/sh
# Real processes that are stopped and continued (SIGSTOP, SIGCONT), over loopback: a server and a
# guest whose hand moves by itself. Each is stopped in turn for 0.05 to 1 s, ten times.
#
#   tests/stops.sh [PAUSES...]
#
# LIGHT=1 sets no bar on the reaction and the shape: nobody may be lost, and nothing may panic.
# CORES=1 keeps every core busy meanwhile. Binaries: those of BIN, or built by cargo. Ends with 77
# (skipped) where a tool is missing, and with 1 when a figure is beyond its bar.
set -u
cd "$(dirname "$0")/.."
skip() { echo "skipped: $1"; exit 77; }
[ -r /proc/loadavg ] || skip "needs Linux"
env --default-signal=INT true 2>/dev/null || skip "no env of GNU coreutils"
if [ -z "${BIN:-}" ]; then
    cargo build --release -p pliant_examples --no-default-features --features net \
        --example dedicated_server --example join || exit 2
    BIN=$(cargo metadata --format-version 1 --no-deps |
        sed 's/.*"target_directory":"\([^"]*\)".*/\1/')/release/examples
fi
[ $# -gt 0 ] || set -- 0.05 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.85 1
seconds=$(printf '%s\n' "$@" | awk '{ all += 2 * $1 + 1.5 } END { print int(all) + 11 }')
work=$(mktemp -d)
pids=""
trap 'for pid in $pids; do kill -CONT "$pid" 2>/dev/null; kill "$pid" 2>/dev/null; done; rm -rf "$work"' EXIT
trap 'exit 130' INT TERM HUP
if [ "${CORES:-}" ]; then
    for _ in $(seq "$(nproc)"); do
        sh -c 'while :; do :; done' &
        pids="$pids $!"
    done
fi
: >"$work/server.log"
env --default-signal=INT "$BIN/dedicated_server" --bind 127.0.0.1:0 --key "$work/key" \
    --trace "$work/truth" --seconds $((seconds + 30)) >"$work/server.log" 2>&1 &
server=$!
pids="$pids $server"
while kill -0 $server 2>/dev/null && ! grep -q "to hold" "$work/server.log"; do sleep 0.1; done
invite=$(sed -n 's/^to hold:  //p' "$work/server.log" | head -1)
env --default-signal=INT "$BIN/join" "$invite" --headless --cached --name a --trace "$work/shown" \
    --seconds "$seconds" >"$work/guest.log" 2>&1 &
guest=$!
pids="$pids $guest"
sleep 8
for pause in "$@"; do
    for pid in $server $guest; do
        kill -STOP "$pid" && sleep "$pause" && kill -CONT "$pid"
        sleep 0.7
    done
done
wait $guest || { tail -3 "$work/guest.log"; exit 1; }
kill -INT $server
wait $server
result=$("$BIN/join" --compare "$work/truth" "$work/shown") || { echo "$result"; exit 1; }
echo "$result"
if grep -qE "panicked|lost the connection" "$work"/*.log; then
    grep -hE "panicked|lost the connection" "$work"/*.log | head -3
    exit 1
fi
# The server makes 40 ticks a second, and the shape is looked at once a tick.
echo "$result" |
    sed 's/.*reaction \([0-9.]*\) N shown, \([0-9.]*\) N true.* for \([0-9]*\) ticks at most$/\1 \2 \3/' |
    awk -v light="${LIGHT:-}" '{
        printf "largest reaction shown over the largest true one: %.3f (at most 1.2)\n", $1 / $2
        printf "shape back within 1 %% after %.3f s (at most 0.525)\n", $3 / 40
        exit !(NF == 3 && $2 > 0 && (light || ($1 <= 1.201 * $2 && $3 <= 21)))
    }'
