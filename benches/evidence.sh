#!/usr/bin/env bash
# Remakes all evidence: the report with its plots, the stability page, the tables beside other
# programs, what scenes leave out, and the pictures. Then a test compares README and book with it.
#
#     benches/evidence.sh [--models DIR] [PART]...
#
# PART: report, stability, peers, leave-out, pictures, claims; all of them if none is given. The
# parts that measure times want a machine that does nothing else. The end tells what each part
# took, which were skipped because something is not installed, and which failed: then the exit
# status is 1.
#
# --models DIR: the folder of bunny.obj (of the Stanford 3D Scanning Repository) and armadillo.obj,
# of which the report measures what is there. Without them it measures the project's own body.
set -uo pipefail
cd "$(dirname "$0")/.." || exit 1

models=models
parts=()
while [ $# -gt 0 ]; do
    case "$1" in
        --models) models="${2:?a folder}" && shift 2 ;;
        report | stability | peers | leave-out | pictures | claims) parts+=("$1") && shift ;;
        *) sed -n '2,13s/^# \{0,1\}//p' "$0" && exit 2 ;;
    esac
done
[ "${#parts[@]}" -gt 0 ] || parts=(report stability peers leave-out pictures claims)

export CARGO_TERM_COLOR=never
program="${CARGO_TARGET_DIR:-target}/release/pliant"
lines=() failed=0
part() {
    local name="$1" began=$SECONDS code=0
    shift
    echo "== $name"
    "$@" || code=$?
    local word
    case "$code" in
        0) word=done ;;
        77) word=skipped ;;
        *) word="failed with $code" failed=1 ;;
    esac
    lines+=("$name: $word in $((SECONDS - began)) s")
}

for name in "${parts[@]}"; do
    case "$name" in report | stability | peers)
        cargo build --quiet --release -p pliant_cli || exit 1
        break
        ;;
    esac
done
for name in "${parts[@]}"; do
    case "$name" in
        report) part report "$program" report --models "$models" -o docs/report ;;
        stability) part stability "$program" stability -o docs/report/stability.md ;;
        peers)
            part peers python3 benches/peers/run.py --pliant "$program" -o docs/report/peers.md
            part bounce python3 benches/peers/bounce.py --pliant "$program" \
                -o docs/report/bounce.md
            ;;
        leave-out) part leave-out python3 benches/leave_out/run.py --one-engine ;;
        pictures) part pictures examples/pictures.sh ;;
        claims) part claims cargo test --quiet -p pliant_cli --test claims ;;
    esac
done
echo
echo "$(date -u +%F), $(nproc) cores, $(uname -m), $(git rev-parse --short HEAD 2>/dev/null):"
printf '  %s\n' "${lines[@]}" "all: $SECONDS s"
exit "$failed"
