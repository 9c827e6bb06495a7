#!/bin/sh
# A session in a browser, for real: moq-relay, a dedicated_server that publishes, the page that
# `pliant watch-page` writes, and headless Chromium. The page computes how far its shapes are from
# the host's truth, and its pixels are compared with what must be seen of that truth, in a window
# and on a phone's screen, which is touched with one finger and with two. Relay and host are killed
# and started again, and the line is cut.
#
#   tests/watch/run.sh
#
# Needs node, openssl, moq-relay 0.17.10 (PLIANT_MOQ_RELAY names it, or it is in PATH: cargo install
# moq-relay --version 0.17.10) and Chromium (PLIANT_CHROMIUM, or in PATH); ends with 77 (skipped)
# where one is missing. Programs: those of BIN (a target folder's debug/ or release/), or built by
# cargo. OUT is a folder for the page's picture. Everything is on loopback, and takes a minute or
# two; a step that takes too long ends it and says what was waited for.
set -u
here=$(cd "$(dirname "$0")" && pwd)
. "$here/common.sh"
command -v node >/dev/null || skip "no node"
chromium=${PLIANT_CHROMIUM:-$(command -v chromium || command -v chromium-browser || command -v google-chrome)}
[ -x "$chromium" ] || skip "no Chromium"
cd "$here/../.."
if [ -z "${BIN:-}" ]; then
    cargo build --release -p pliant_cli || exit 2
    build dedicated_server watch_truth
fi
work=$(mktemp -d)
# Chromium's last processes may still write to its profile.
trap 'rm -rf "$work" 2>/dev/null || { sleep 2; rm -rf "$work"; }' EXIT
trap 'exit 130' INT TERM HUP
RELAY=$relay CHROMIUM=$chromium BIN=$BIN WORK=$work OUT=${OUT:-$work} node "$here/run.mjs"
