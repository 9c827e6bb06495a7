#!/bin/sh
# A session between three network namespaces: a server and two guests, each on a line of its own of
# 2 Mb/s (tbf), with the paper's first network (9 % loss, 196 ms) emulated on top, 60 s of two hands
# dragging; then what happens when processes and lines die.
#
#   tests/netns/run.sh [SECONDS] [drag|faults|all]
#
# Needs root or CAP_NET_ADMIN, `ip` and `tc`; says so and ends with 77 (skipped) where it is not
# allowed. Binaries: those of BIN, or built by cargo.
# Ends with 1 when a figure is beyond its bar. The figures of `drag` are of a session in real time:
# where something else keeps the machine busy it ends with 77, too; BUSY=1 measures all the same.
set -u
cd "$(dirname "$0")/../.."
seconds=${1:-60}
what=${2:-all}

skip() { echo "skipped: $1"; exit 77; }
command -v ip >/dev/null || skip "no ip"
command -v tc >/dev/null || skip "no tc"
env --default-signal=INT true 2>/dev/null || skip "no env of GNU coreutils"
busy() { awk -v cores="$(nproc)" '{ exit !($1 > cores / 2) }' /proc/loadavg; }
if [ -z "${BUSY:-}" ] && [ "$what" != faults ] && busy; then
    skip "the machine is busy: load $(cut -d' ' -f1 /proc/loadavg) on $(nproc) cores"
fi
tag=pl$$
ip netns add $tag-s 2>/dev/null || skip "network namespaces are not allowed here"

work=$(mktemp -d)
pids=""
cleanup() {
    for pid in $pids; do kill "$pid" 2>/dev/null; done
    for ns in s a b; do ip netns del $tag-$ns 2>/dev/null; done
    [ "${KEEP:-}" ] && echo "kept $work" || rm -rf "$work"
}
trap cleanup EXIT
trap 'exit 130' INT TERM HUP

if [ -z "${BIN:-}" ]; then
    cargo build --release -p pliant_examples --no-default-features --features net \
        --example dedicated_server --example join || exit 2
    BIN=$(cargo metadata --format-version 1 --no-deps |
        sed 's/.*"target_directory":"\([^"]*\)".*/\1/')/release/examples
fi

# A line: a pair of veths with a token bucket at both ends.
line() {
    ip netns add $tag-$1 &&
        ip link add $tag-$1 netns $tag-$1 type veth peer name v$1 netns $tag-s || skip "no veth"
    ip netns exec $tag-s ip addr add 10.77.$2.1/24 dev v$1
    ip netns exec $tag-$1 ip addr add 10.77.$2.2/24 dev $tag-$1
    for end in "$tag-s v$1" "$tag-$1 $tag-$1"; do
        set -- "$1" "$2" $end
        ip netns exec "$3" ip link set "$4" up
        ip netns exec "$3" \
            tc qdisc add dev "$4" root tbf rate 2mbit burst 16kb latency 50ms || skip "no tbf"
    done
    ip netns exec $tag-$1 ip link set lo up
    ip netns exec $tag-$1 ip route add default via 10.77.$2.1
}
line a 1
line b 2
ip netns exec $tag-s ip link set lo up

serve() { # log, more options
    log=$1; shift; : >"$log"
    ip netns exec $tag-s env --default-signal=INT "$BIN/dedicated_server" \
        --bind 0.0.0.0:4433 --key "$work/key" "$@" >"$log" 2>&1 &
    server=$!
    pids="$pids $server"
    while kill -0 $server 2>/dev/null && ! grep -q "to hold" "$log"; do sleep 0.1; done
    key=$(sed -n 's/.*#\([0-9a-f]*\).*/\1/p' "$log" | head -1)
}
# guest NAME NET LOG options
guest() {
    ns=$1; net=$2; log=$3; shift 3; : >"$log"
    ip netns exec $tag-$ns env --default-signal=INT "$BIN/join" "pliant://10.77.$net.1:4433#$key" \
        --headless --cached --name "$ns" "$@" >"$log" 2>&1 &
    last=$!
    pids="$pids $last"
}
now() { date +%s.%N; }
since_t0() { awk "BEGIN { printf \"%.1f\n\", $(now) - $t0 }"; }
failed=0
# Also from within `$(...)`, where a variable would be lost.
fail() { touch "$work/failed"; }
bar() { # name value most
    if awk "BEGIN { exit !($2 <= $3) }"; then
        echo "ok    $1: $2 (at most $3)"
    else
        echo "ABOVE $1: $2 (at most $3)"
        failed=1
    fi
}

# What a pattern with one group finds in $result.
found() { echo "$result" | sed "s/.*$1.*/\\1/"; }

drag() {
    echo "== $seconds s of two hands over 2 Mb/s, 9 % and 196 ms each"
    serve "$work/server.log" --trace "$work/truth" --seconds $((seconds + 15))
    set -- --network paper-1 --seconds "$seconds"
    guest a 1 "$work/a.log" "$@" --seed 2 --trace "$work/a.trace"; ga=$last
    guest b 2 "$work/b.log" "$@" --seed 3 --trace "$work/b.trace"; gb=$last
    sleep 5
    from=$(cat_bytes); t0=$(now)
    wait $ga $gb
    to=$(cat_bytes); t1=$(now)
    kill -INT $server; wait $server
    for g in a b; do
        tail -1 "$work/$g.log"
        result=$("$BIN/join" --compare "$work/truth" "$work/$g.trace") || {
            echo "$result"
            failed=1
            continue
        }
        echo "$g: $result"
        bar "$g: shown error rms, %" "$(found 'shown error \([0-9.]*\) % rms')" 0.2
        bar "$g: shown error at most, %" \
            "$(found 'shown error [0-9.]* % rms, \([0-9.]*\) % at most')" 3
        bar "$g: reaction rms, %" "$(found 'reaction \([0-9.]*\) % rms')" 10
        set -- $(echo "$result" | sed 's/^\([0-9]*\) of \([0-9]*\) ticks.*/\1 \2/')
        bar "$g: ticks not shown, %" "$(awk "BEGIN { print 100 * (1 - $1 / $2) }")" 0.1
        # Five seconds to come in and five that are not compared; a guest that was out for long has
        # fewer.
        bar "$g: ticks missed by coming late, %" \
            "$(awk "BEGIN { print 100 * (1 - $2 / (40 * ($seconds - 10))) }")" 0
    done
    set -- $from $to
    bar "a: line used, kbit/s" "$(awk "BEGIN { print ($3 - $1) * 8e-3 / ($t1 - $t0) }")" 2000
    bar "b: line used, kbit/s" "$(awk "BEGIN { print ($4 - $2) * 8e-3 / ($t1 - $t0) }")" 2000
}
# Bytes that the server has sent on each line.
cat_bytes() {
    for v in va vb; do
        ip netns exec $tag-s cat /sys/class/net/$v/statistics/tx_bytes
    done | tr '\n' ' '
}

# wait_for LOG PATTERN SECONDS: prints how long it took.
wait_for() {
    t0=$(now)
    for _ in $(seq $(($3 * 20))); do
        if grep -q "$2" "$1"; then since_t0; return 0; fi
        sleep 0.05
    done
    echo "not within $3 s"; fail; return 1
}

faults() {
    echo "== faults: who noticed, after how long"
    serve "$work/s1.log"
    guest a 1 "$work/fa.log"; ga=$last
    guest b 2 "$work/fb.log"; gb=$last
    for log in fa fb; do wait_for "$work/$log.log" "in as user" 60 >/dev/null; done
    sleep 2

    kill -9 $gb
    after=$(wait_for "$work/s1.log" "b has left" 60)
    losses=$(seen "$work/fa.log" "lost the connection")
    echo "kill -9 of guest b: the server, after $after s; guest a goes on: $losses losses"

    ip netns exec $tag-s ip link set va down; sleep 10; ip netns exec $tag-s ip link set va up
    after=$(wait_for_again "$work/fa.log" 60)
    losses=$(seen "$work/fa.log" "lost the connection")
    echo "line a down for 10 s: guest a back after $after s of line; losses it saw: $losses"

    before=$(seen "$work/fa.log" "lost the connection"); again=$(seen "$work/fa.log" " again")
    kill -9 $server
    after=$(wait_for_more "$work/fa.log" "lost the connection" "$before" 60)
    echo "kill -9 of the server: guest a, after $after s"
    serve "$work/s2.log"
    after=$(wait_for_more "$work/fa.log" " again" "$again" 60)
    guests=$(seen "$work/s2.log" "has joined")
    echo "server started anew: guest a in again after $after s; the server has $guests guest(s)"
    t0=$(now); kill -INT $ga; wait $ga 2>/dev/null
    echo "Ctrl-C at guest a: the server, after $(wait_for "$work/s2.log" "a has left" 60) s"
    if grep -qE "ERROR|panicked" "$work"/*.log; then
        echo "errors in the logs:"
        grep -hE "ERROR|panicked" "$work"/*.log | head -5
        failed=1
    else
        echo "no error in any log"
    fi
    kill -INT $server; wait $server 2>/dev/null
}
# seen LOG PATTERN: how many lines there are; wait_for_more LOG PATTERN SEEN SECONDS: until there
# are more.
seen() { grep -c "$2" "$1"; }
wait_for_more() {
    t0=$(now)
    for _ in $(seq $(($4 * 20))); do
        if [ "$(seen "$1" "$2")" -gt "$3" ]; then since_t0; return 0; fi
        sleep 0.05
    done
    echo "not within $4 s"; fail; return 1
}
# Data flows again: a line of figures with datagrams coming.
wait_for_again() {
    t0=$(now)
    for _ in $(seq $(($2 * 20))); do
        in=$(tail -1 "$1" | sed -n 's/.*  *\([0-9]*\) kbit\/s in.*/\1/p')
        if [ "${in:-0}" -gt 10 ]; then since_t0; return 0; fi
        sleep 0.05
    done
    echo "not within $2 s"; fail; return 1
}

case $what in
    drag) drag ;;
    faults) faults ;;
    *) drag; faults ;;
esac
[ -e "$work/failed" ] && failed=1
exit $failed
