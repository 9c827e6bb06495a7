#!/bin/sh
# A watcher whose line is cut for ten seconds, and a host whose line is: a relay, a host and a
# watcher in a network namespace each, joined by pairs of virtual wires, of which one is taken down
# and put up again. The watcher has to see the session again by itself.
#
#   tests/watch/cut.sh BODY.modal
#
# Prints how long the watcher saw nothing, which has the ten seconds in it. Needs root or
# CAP_NET_ADMIN, `ip`, openssl and moq-relay 0.17.10 (PLIANT_MOQ_RELAY, or in PATH); ends with 77
# (skipped) where one is missing. Programs: those of BIN (a target folder's debug/ or release/), or
# built by cargo. It takes a minute and a half.
set -u
. "$(dirname "$0")/common.sh"
command -v ip >/dev/null || skip "no ip"
body=$(realpath "${1:?which body}")
cd "$(dirname "$0")/../.."
build dedicated_server watch_load
tag=pw$$
ip netns add $tag-r 2>/dev/null || skip "network namespaces are not allowed here"
work=$(mktemp -d)
pids=""
stop() { for pid in $pids; do kill "$pid" 2>/dev/null; done; wait; pids=""; }
trap 'stop; for ns in r h w; do ip netns del $tag-$ns 2>/dev/null; done; rm -rf "$work"' EXIT
trap 'exit 130' INT TERM HUP
line() { # name of the namespace, number of the net
    ip netns add $tag-$1 &&
        ip link add $tag-$1 netns $tag-$1 type veth peer name v$1 netns $tag-r || skip "no veth"
    ip netns exec $tag-r ip addr add 10.78.$2.1/24 dev v$1
    ip netns exec $tag-$1 ip addr add 10.78.$2.2/24 dev $tag-$1
    ip netns exec $tag-r ip link set v$1 up
    ip netns exec $tag-$1 ip link set $tag-$1 up
    ip netns exec $tag-$1 ip link set lo up
}
ip netns exec $tag-r ip link set lo up
line h 1
line w 2
mkdir "$work/tls"
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 10 \
    -subj /CN=localhost -addext subjectAltName=IP:10.78.1.1,IP:10.78.2.1 \
    -keyout "$work/tls/key" -out "$work/tls/certificate" 2>/dev/null || exit 2
hash=$(openssl x509 -in "$work/tls/certificate" -outform der | openssl dgst -sha256 -r | cut -d' ' -f1)
ip netns exec $tag-r "$relay" --listen 0.0.0.0:4480 --listen-tls-cert "$work/tls/certificate" \
    --listen-tls-key "$work/tls/key" --auth-public '**' >"$work/relay.log" 2>&1 &
pids="$pids $!"
sleep 1
ip netns exec $tag-h "$BIN/examples/dedicated_server" --bind 127.0.0.1:0 --hz 60 --play \
    --body "$body" --publish https://10.78.1.1:4480/ --certificate "$hash" --session cut \
    >"$work/host.log" 2>&1 &
pids="$pids $!"
sleep 3
for who in w h; do
    ip netns exec $tag-w "$BIN/examples/watch_load" https://10.78.2.1:4480/ "$hash" cut "$body" 1 35 \
        >"$work/seen" 2>"$work/seen.log" &
    watcher=$!
    pids="$pids $watcher"
    # The first picture is there.
    for _ in $(seq 100); do
        grep -q measuring "$work/seen.log" && break
        sleep 0.3
    done
    sleep 2
    # The wire's far end goes down, so that the process sees no change of its own interface.
    ip netns exec $tag-r ip link set v$who down
    sleep 10
    ip netns exec $tag-r ip link set v$who up
    wait "$watcher"
    silence=$(sed -n 's/.*"silence_s":\([0-9.]*\).*/\1/p' "$work/seen")
    [ "$who" = w ] && what="the watcher's line" || what="the host's line"
    echo "$what cut for 10 s: nothing was seen for ${silence:-ever} s"
    # The pauses between tries to reach a relay are 4 s at most, and an answer may take as long.
    awk -v silence="${silence:-1000}" 'BEGIN { exit !(silence > 9 && silence < 28) }' || {
        tail -n 5 "$work"/*.log "$work/seen"
        exit 1
    }
done
echo "all is well"
