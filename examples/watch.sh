#!/usr/bin/env bash
# A session that anyone can watch in a browser, on this machine: a relay, a host and a web server
# with the page. Prints the link; Ctrl-C ends all three.
#
#   examples/watch.sh [ARGUMENTS of dedicated_server ...]      such as --body bud.modal
#
# Needs moq-relay, which others have written, in PATH or named by PLIANT_MOQ_RELAY. It is installed
# by
#
#   cargo install moq-relay --version 0.17.10
#
# which takes some minutes. Besides: curl, and python3 as the web server. The host and the program
# pliant are built by cargo, without a window or a renderer, unless BIN is a folder that has them (a
# target folder's debug/ or release/). PORT is the page's, 8000 by default. Everything listens on
# loopback: docs/watching.md says what changes for other machines.
set -euo pipefail
cd "$(dirname "$0")/.."

relay="${PLIANT_MOQ_RELAY:-$(command -v moq-relay || true)}"
if [ ! -x "$relay" ]; then
    echo "no moq-relay: cargo install moq-relay --version 0.17.10" >&2
    exit 77
fi
for program in curl python3; do
    command -v "$program" >/dev/null || { echo "no $program" >&2; exit 77; }
done
if [ -z "${BIN:-}" ]; then
    cargo build --release -p pliant_cli
    cargo build --release -p pliant_examples --no-default-features --features watch \
        --example dedicated_server
    target="$(cargo metadata --format-version 1 --no-deps)"
    BIN="$(sed 's/.*"target_directory":"\([^"]*\)".*/\1/' <<<"$target")/release"
fi

work="$(mktemp -d)"
pids=()
cleanup() {
    for pid in "${pids[@]}"; do kill "$pid" 2>/dev/null || true; done
    wait
    rm -rf "$work"
}
trap cleanup EXIT
trap 'exit 130' INT TERM HUP

page="${PORT:-8000}"
"$BIN/pliant" watch-page "$work/site" >/dev/null
python3 -m http.server --bind 127.0.0.1 --directory "$work/site" "$page" >"$work/web.log" 2>&1 &
pids+=($!)

# The relay makes itself a certificate, and says its hash on the same port over HTTP.
at="127.0.0.1:${RELAY_PORT:-4443}"
"$relay" --listen "$at" --listen-tls-generate localhost --web-http-listen "$at" \
    --auth-public '**' >"$work/relay.log" 2>&1 &
pids+=($!)
hash=""
for _ in $(seq 100); do
    hash="$(curl -fs "http://$at/certificate.sha256" || true)"
    [ -n "$hash" ] && break
    sleep 0.1
done
[ -n "$hash" ] || { echo "the relay does not answer:" >&2; tail -5 "$work/relay.log" >&2; exit 1; }
kill -0 "${pids[0]}" 2>/dev/null || { cat "$work/web.log" >&2; exit 1; }

# Whoever opens the link sees the body that a hand of the host moves; an invite lets people hold it.
"$BIN/examples/dedicated_server" --bind 127.0.0.1:0 --hz 60 --play --publish "https://$at/" \
    --certificate "$hash" --page "http://127.0.0.1:$page/" "$@" &
pids+=($!)
wait "$!"
