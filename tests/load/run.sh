#!/bin/sh
# What a server costs by the number of its users: one dedicated_server, bots that join, receive and
# count, both on this machine over loopback. Prints a table in Markdown (docs/multiuser-load.md is
# one) and ends with 1 when a bar is missed: every tick sent and received (but for one in 100,000
# that the bots, which share the machine, may miss), a tick below 5 ms at 99 %.
#
#   tests/load/run.sh BODY.modal [SECONDS of the largest [USERS...]]
#
# LIGHT=1: no bars on times, for an unoptimized build or a busy machine: only nothing may be
# missing. SENT=1: the bots have no model, so that it is sent to all of them at once. AS="chrt --rr
# 10" or another prefix for the server's command, so that the bots' threads and whatever else runs
# here do not take its processor from it. Binaries: those of BIN, or built by cargo.
#
# Its figures are times. Where something else keeps the machine busy it says so and ends with 77
# (skipped); BUSY=1 measures all the same.
set -u
skip() { echo "skipped: $1"; exit 77; }
[ -r /proc/loadavg ] || skip "needs Linux: no /proc/loadavg"
env --default-signal=INT true 2>/dev/null || skip "needs env of GNU coreutils"
if [ -z "${BUSY:-}${LIGHT:-}" ] && awk -v cores="$(nproc)" '{ exit !($1 > cores / 2) }' /proc/loadavg; then
    skip "the machine is busy: load $(cut -d' ' -f1 /proc/loadavg) on $(nproc) cores"
fi
body=$(realpath "${1:?which body}")
long=${2:-60}
[ $# -ge 2 ] && shift 2 || shift $#
users=${*:-1 16 64 128 256}
cd "$(dirname "$0")/../.."
if [ -z "${BIN:-}" ]; then
    cargo build --release -p pliant_examples --no-default-features --features net \
        --example dedicated_server --example join || exit 2
    BIN=$(cargo metadata --format-version 1 --no-deps |
        sed 's/.*"target_directory":"\([^"]*\)".*/\1/')/release/examples
fi
cached=--cached
[ "${SENT:-}" ] && cached=""
work=$(mktemp -d)
server=""
trap 'kill $server 2>/dev/null; rm -rf "$work"' EXIT
trap 'exit 130' INT TERM HUP
failed=0
echo "load before: $(cut -d' ' -f1-3 /proc/loadavg), $(nproc) cores"
printf '%s' "| users | ticks/s | a tick, median, ms | at 99 % | at most | processor, % "
printf '%s' "| memory, MB, first and last | out, Mbit/s | kbit/s a user | dropped "
echo "| ticks received | missing |"
echo "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
for n in $users; do
    seconds=20
    [ "$n" = "${users##* }" ] && seconds=$long
    env --default-signal=INT ${AS:-} "$BIN/dedicated_server" --bind 127.0.0.1:0 --hz 60 --play \
        --body "$body" --guests "$n" >"$work/server" 2>&1 &
    server=$!
    while kill -0 $server 2>/dev/null && ! grep -q "to hold" "$work/server"; do sleep 0.1; done
    invite=$(sed -n 's/^to hold:  //p' "$work/server" | head -1)
    # Five seconds to come in, and the windows of ten seconds do not begin with the bots.
    "$BIN/join" "$invite" --bots "$n" --light $cached --body "$body" \
        --seconds $((seconds + 15)) >"$work/bots" 2>&1 || { tail -3 "$work/bots"; failed=1; }
    kill -INT $server; wait $server 2>/dev/null
    server=""
    # Windows with all users from beginning to end: the first one with all of them may have begun
    # before they were in.
    grep "^$n users" "$work/server" | sed 1d >"$work/full"
    last=$(tail -1 "$work/bots")
    received=$(echo "$last" | sed 's/.*; \([0-9]*\) ticks received.*/\1/')
    missing=$(echo "$last" | sed 's/.*received, \([0-9]*\) missing.*/\1/')
    awk -v n="$n" -v light="${LIGHT:-}" -v received="$received" -v missing="$missing" '
        function after(word,  at) {
            at = index($0, word)
            return substr($0, at + length(word)) + 0
        }
        {
            rate = after("users, "); median = after("a tick "); at99 = after("in the median, ")
            most = after("99 %, "); cpu += after("processor "); mem = after("memory ")
            out += after("MB, "); gone = after("Mbit/s out, ")
            if (!k++) first = mem
            if (median > md) md = median
            if (at99 > p) p = at99
            if (most > m) m = most
            if (!low || rate < low) low = rate
        }
        END {
            if (!k) { print "| " n " | not all came in |"; exit 1 }
            printf "| %d | %.1f | %.2f | %.2f | %.1f ", n, low, md, p, m
            printf "| %.0f | %.0f, %.0f | %.2f ", cpu / k, first, mem, out / k
            printf "| %.1f | %d | %d | %d |\n", 1e3 * out / k / n, gone, received, missing
            exit !(missing <= 1e-5 * received && gone == 0 && (light || p < 5 && low > 59.4))
        }' "$work/full" || failed=1
done
echo "load after: $(cut -d' ' -f1-3 /proc/loadavg)"
exit $failed
