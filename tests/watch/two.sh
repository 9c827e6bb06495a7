#!/bin/sh
# Two relays as docs/watching.md has them for two places, here both on loopback: certificates of an
# authority, tokens of `moq auth`, a second relay that fetches from the first. Without a token one
# may watch at the first and do nothing at the second; only the host's token publishes.
#
#   tests/watch/two.sh BODY.modal
#
# Needs moq-relay 0.17.10 and moq 0.14.10 (PLIANT_MOQ_RELAY and PLIANT_MOQ name them, or they are in
# PATH: cargo install moq-relay --version 0.17.10, cargo install moq-cli --version 0.14.10) and
# openssl; ends with 77 (skipped) where one is missing. Programs: those of BIN (a target folder's
# debug/ or release/), or built by cargo. It takes a minute.
set -u
. "$(dirname "$0")/common.sh"
moq=${PLIANT_MOQ:-$(command -v moq)}
[ -x "$moq" ] || skip "no moq (cargo install moq-cli --version 0.14.10)"
body=$(realpath "${1:?which body}")
cd "$(dirname "$0")/../.."
build dedicated_server watch_load
work=$(mktemp -d)
pids=""
trap 'for pid in $pids; do kill "$pid" 2>/dev/null; done; wait; rm -rf "$work"' EXIT
trap 'exit 130' INT TERM HUP
run() { # name of the log, command
    log="$work/$1.log"
    shift
    "$@" >"$log" 2>&1 &
    pids="$pids $!"
}
fail() {
    echo "failed: $1"
    tail -n 5 "$work"/*.log
    exit 1
}

# An authority, which everybody here trusts, and a certificate for both relays.
mkdir "$work/tls"
(
    cd "$work/tls" || exit
    curve="-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
    # shellcheck disable=SC2086
    openssl req -x509 $curve -days 10 -subj /CN=authority -keyout ca.key -out ca.pem &&
        openssl req $curve -subj /CN=localhost -keyout privkey.pem -out request.pem &&
        echo subjectAltName=IP:127.0.0.1 >names &&
        openssl x509 -req -in request.pem -CA ca.pem -CAkey ca.key -CAcreateserial -days 10 \
            -extfile names -out fullchain.pem
) 2>/dev/null || exit 2
export SSL_CERT_FILE="$work/tls/ca.pem"

# Tokens: the host's, the second relay's, a watcher's, and a watcher's of yesterday.
sign() { "$moq" auth sign --key "$work/private.jwk" "$@" || exit 2; }
"$moq" auth generate --algorithm ES256 --out "$work/private.jwk" --public "$work/public.jwk" ||
    exit 2
now=$(date +%s)
host=$(sign --publish 'lectures/**' --expires $((now + 86400)))
sign --publish '**' --subscribe '**' >"$work/boston.jwt"
watcher=$(sign --subscribe 'lectures/*')
late=$(sign --subscribe 'lectures/*' --expires $((now - 86400)))

port=${RELAY_PORT:-4470}
a="https://127.0.0.1:$port/"
b="https://127.0.0.1:$((port + 1))/"
start() { # name, port, more arguments of the relay
    name=$1
    at=$2
    shift 2
    run "$name" "$relay" --listen "127.0.0.1:$at" --listen-tls-cert "$work/tls/fullchain.pem" \
        --listen-tls-key "$work/tls/privkey.pem" --auth-url "http://127.0.0.1:$((at + 2))/" \
        --cache-capacity 512MB "$@"
}
run auth-a "$moq" auth serve --listen "127.0.0.1:$((port + 2))" --key "$work/public.jwk" \
    --public-subscribe 'lectures/**'
run auth-b "$moq" auth serve --listen "127.0.0.1:$((port + 3))" --key "$work/public.jwk"
sleep 1
start a "$port"
sleep 1
start b $((port + 1)) --cluster-connect "$a" --cluster-token "$work/boston.jwt"
publish() { # name of the session, relay with a token
    run "host-${1##*/}" "$BIN/examples/dedicated_server" --bind 127.0.0.1:0 --hz 60 --play \
        --body "$body" --publish "$2" --link-relay "$b" --session "$1"
}
publish lectures/heart "$a?jwt=$host"
publish lectures/none "$a"
publish lectures/watcher "$a?jwt=$watcher"
sleep 3
grep -q "eyJ" "$work/host-heart.log" && fail "a token is in the link for watchers"

# Whether one watcher at a relay sees a session within ten seconds.
sees() { # relay with a token, session
    timeout 10 "$BIN/examples/watch_load" "$1" system "$2" "$body" 1 2 \
        >"$work/seen" 2>"$work/seen.log"
    case $? in
    0) grep -q '"with_picture":1' "$work/seen" ;;
    124) false ;;
    *) fail "watch_load" ;;
    esac
}
sees "$b?jwt=$watcher" lectures/heart || fail "a token shows nothing at the second relay"
sees "$a" lectures/heart || fail "a watcher without a token sees nothing at the first relay"
sees "$b" lectures/heart && fail "a watcher without a token sees a session at the second relay"
sees "$b?jwt=$late" lectures/heart && fail "a watcher with a token of yesterday sees a session"
for session in none watcher; do
    sees "$a" "lectures/$session" && fail "a host without the host's token published: $session"
done
sees "$b?jwt=$watcher" lectures/heart || fail "the session is no longer at the second relay"
echo "all is well"
