#!/bin/sh
# What a session costs by the number of its watchers: the host, one relay or a cluster of two, and
# the delay and the missing frames of the watchers, all on this machine over loopback. Prints a line
# of JSON for each number of watchers, then the host's lines of the measured time.
#
#   tests/watch/load.sh BODY.modal [WHOLE_SECONDS [WATCHERS...]]
#
# RELAYS=2: two relays, of which the second fetches from the first, with half of the watchers each.
# MODELS=fetch: each fetches the model first. RATE: frames a second, 30 by default. AS: a command
# that runs the host, such as nice -n -5. In a network namespace of its own (unshare -n sh -c 'ip
# link set lo up; tests/watch/load.sh ...') the bytes that are told are these processes' alone.
# Needs moq-relay 0.17.10 (PLIANT_MOQ_RELAY, or in PATH), openssl and Linux; ends with 77 (skipped)
# without. Programs: those of BIN (a target folder's debug/ or release/), or built by cargo.
set -u
. "$(dirname "$0")/common.sh"
[ -r /proc/self/stat ] || skip "needs Linux"
body=$(realpath "${1:?which body}")
seconds=${2:-20}
[ $# -ge 2 ] && shift 2 || shift $#
watchers=${*:-1 10 100}
cd "$(dirname "$0")/../.."
build dedicated_server watch_load
# Each watcher has a socket of its own.
ulimit -n "$(ulimit -Hn)"
work=$(mktemp -d)
pids=""
stop() { for pid in $pids; do kill "$pid" 2>/dev/null; done; wait; pids=""; }
trap 'stop; rm -rf "$work"' EXIT
trap 'exit 130' INT TERM HUP
# A folder of their own: a relay reads its certificate anew after each change beside it, and says
# so, and a log there is such a change.
tls="$work/tls"
mkdir "$tls"
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 10 -subj /CN=localhost \
    -addext subjectAltName=IP:127.0.0.1 -keyout "$tls/key" -out "$tls/certificate" 2>/dev/null || exit 2
hash=$(openssl x509 -in "$tls/certificate" -outform der | openssl dgst -sha256 -r | cut -d' ' -f1)
start() { # port, more arguments
    port=$1
    shift
    "$relay" --listen "127.0.0.1:$port" --listen-tls-cert "$tls/certificate" \
        --listen-tls-key "$tls/key" --auth-public '**' "$@" >>"$work/relay.log" 2>&1 &
    pids="$pids $!"
}
first=${RELAY_PORT:-4460}
for n in $watchers; do
    start "$first"
    measured="relay=$!"
    at="https://127.0.0.1:$first/"
    if [ "${RELAYS:-1}" = 2 ]; then
        sleep 1
        start $((first + 1)) --cluster-connect "$at" --connect-tls-fingerprint "$hash"
        measured="$measured second=$!"
        at="$at,https://127.0.0.1:$((first + 1))/"
    fi
    # The host's ticks are among what is measured, so it goes before the watchers.
    ${AS:-} "$BIN/examples/dedicated_server" --bind 127.0.0.1:0 --hz 60 --play --body "$body" \
        --publish "https://127.0.0.1:$first/" --certificate "$hash" --session load \
        --watch-rate "${RATE:-30}" >"$work/host.log" 2>&1 &
    pids="$pids $!"
    measured="$measured host=$!"
    sleep 3
    # shellcheck disable=SC2086
    "$BIN/examples/watch_load" "$at" "$hash" load "$body" "$n" "$seconds" $measured || {
        tail -3 "$work/relay.log" "$work/host.log" >&2
        exit 1
    }
    # A line of the host is about ten seconds.
    tail -n "$((seconds < 20 ? 1 : seconds / 10))" "$work/host.log"
    stop
done
