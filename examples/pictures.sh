#!/usr/bin/env bash
# Remakes the pictures of the gallery (examples/README.md) in docs/images, without a screen: under
# Xvfb, and with a software driver where there is no graphics card.
#
#   examples/pictures.sh [NAME ...]      all of them, or those named
#
# Each is made by the example itself (--screenshot), at 1280x720, and has at most 300,000 bytes: a
# larger one gets a palette where Python's Pillow or ImageMagick is there, and is taken smaller if
# that is not enough. OUT is another folder for them, BIN one with the examples' binaries, PROFILE
# one of cargo's. What the recording's picture and Blender's need besides is told where it is
# missing, and these pictures stay as they are.
set -euo pipefail
cd "$(dirname "$0")/.."

if [ -z "${PICTURES_DISPLAY:-}" ]; then
    command -v xvfb-run >/dev/null && command -v xauth >/dev/null || {
        echo "skipped: no xvfb-run or xauth (Debian: xvfb xauth, and without a graphics card" \
            "mesa-vulkan-drivers libvulkan1)" >&2
        exit 77
    }
    PICTURES_DISPLAY=1 exec xvfb-run -a -s "-screen 0 1280x720x24" "$0" "$@"
fi
export PICTURES_DISPLAY

out="$(realpath -m "${OUT:-docs/images}")"
mkdir -p "$out"
most=300000
work="$(mktemp -d)"
pids=()
cleanup() {
    for pid in "${pids[@]}"; do kill "$pid" 2>/dev/null || true; done
    rm -rf "$work"
}
trap cleanup EXIT

if [ -z "${BIN:-}" ]; then
    cargo build --profile "${PROFILE:-dev}" --examples
    profile="${PROFILE:-dev}"
    [ "$profile" = dev ] && profile=debug
    target="$(cargo metadata --format-version 1 --no-deps)"
    target="$(sed 's/.*"target_directory":"\([^"]*\)".*/\1/' <<<"$target")"
    BIN="$target/$profile/examples"
fi
BIN="$(realpath "$BIN")"
root="$PWD"

wanted=("$@")
is_wanted() {
    [ "${#wanted[@]}" -eq 0 ] && return 0
    for name in "${wanted[@]}"; do [ "$name" = "$1" ] && return 0; done
    return 1
}

# As many colors as there is room for, or give up.
smaller() {
    if python3 -c 'import PIL' 2>/dev/null; then
        python3 - "$1" "$most" <<'PYTHON'
import os, sys
from PIL import Image
file, most = sys.argv[1], int(sys.argv[2])
picture = Image.open(file).convert("RGB")
for colors in 256, 192, 128:
    # Small parts of a picture get colors, too.
    method = Image.Quantize.MAXCOVERAGE
    picture.quantize(colors, method, dither=Image.Dither.NONE).save(file, optimize=True)
    if os.path.getsize(file) <= most:
        break
PYTHON
    elif command -v magick >/dev/null; then
        magick "$1" +dither -colors 128 "png8:$1"
    else
        return 1
    fi
}

picture() { # name of the picture, example, arguments
    local name="$1" example="$2"
    shift 2
    is_wanted "$name" || return 0
    local file="$work/$name.png" bytes size
    for size in "" 896x504 640x360; do
        # What the example records or prints is not wanted here.
        (cd "$work" && "$BIN/$example" "$@" ${size:+--size "$size"} --screenshot "$file") \
            >"$work/$name.log" 2>&1 || { cat "$work/$name.log" >&2; return 1; }
        if [ "$(stat -c %s "$file")" -gt $most ]; then smaller "$file" || true; fi
        bytes="$(stat -c %s "$file")"
        [ "$bytes" -gt $most ] || break
    done
    [ "$bytes" -le $most ] || {
        echo "$name.png has $bytes bytes, at most $most are wanted" >&2
        return 1
    }
    mv "$file" "$out/$name.png"
    printf '%-24s %7d bytes, %d s\n' "$name.png" "$bytes" "$SECONDS"
}


picture hello_body hello_body
picture many_bodies many_bodies
picture materials materials
picture elasticity elasticity
picture free_bodies free_bodies
picture falling falling
picture pile pile
picture from_blender from_blender
picture mobile mobile
picture walk walk
picture touch touch
picture feel feel
picture two_hands two_hands
# A slow renderer needs a while until the body is there.
picture shared_body shared_body --seconds 25
picture tug_of_war tug_of_war
picture menu menu
for scene in "$root"/assets/scenes/*.ron; do
    picture "scene-$(basename "$scene" .ron)" scene "$scene"
done

# The live panel: all of it, as it is on a dense screen, and the part about the network.
picture panel hello_body --panel --seconds 1
picture panel-scale-2 hello_body --panel --seconds 1 --size 2560x1440 --scale 2
picture panel-session shared_body --panel=session --seconds 25

# The model and what is painted on it, by Blender itself, as a program or as a module of Python.
if is_wanted blender; then
    bird="$root/tests/blender/bird.py"
    if command -v blender >/dev/null; then
        blender --background --python "$bird" -- "$work/bird.glb" "$work/blender.png"
    elif python3 -c 'import bpy' 2>/dev/null; then
        python3 "$bird" "$work/bird.glb" "$work/blender.png"
    else
        echo "blender.png stays: there is no Blender (or its module for Python: pip install bpy)" >&2
    fi >"$work/bird.log"
    if [ -s "$work/blender.png" ]; then
        if [ "$(stat -c %s "$work/blender.png")" -gt $most ]; then smaller "$work/blender.png"; fi
        mv "$work/blender.png" "$out/blender.png"
    fi
fi

# A recording in its viewer, short enough to be read before the picture is taken; on a busy machine
# plots may be empty all the same: look at it, and run this again. The window is at the corner of a
# larger screen, so that the pointer, which is at its center, is not over it. The viewer that draws
# in software may end with an error after it has written the picture, which has two pixels for each
# of the window's.
if is_wanted recording; then
    if command -v rerun >/dev/null && python3 -c 'import PIL' 2>/dev/null; then
        (cd "$work" && "$BIN/shared_body" --headless --seconds 20 --rerun out.rrd) \
            >"$work/recording.log" 2>&1 || { cat "$work/recording.log" >&2; exit 1; }
        (cd "$work" && HOME="$work" timeout 600 xvfb-run -a -s "-screen 0 5400x3000x24" \
            rerun out.rrd --bind 127.0.0.1 --port 0 --screenshot-to recording.png \
            --window-size 1280x720) >"$work/viewer.log" 2>&1 || true
        [ -s "$work/recording.png" ] || { cat "$work/viewer.log" >&2; exit 1; }
        python3 - "$work/recording.png" <<'PYTHON'
import sys
from PIL import Image
Image.open(sys.argv[1]).convert("RGB").resize((1280, 720), Image.LANCZOS).save(sys.argv[1], optimize=True)
PYTHON
        if [ "$(stat -c %s "$work/recording.png")" -gt $most ]; then smaller "$work/recording.png"; fi
        mv "$work/recording.png" "$out/recording.png"
        printf '%-24s %7d bytes, %d s\n' recording.png "$(stat -c %s "$out/recording.png")" "$SECONDS"
    else
        echo "recording.png stays: there is no viewer or no Pillow" \
            "(pip install rerun-sdk==0.36.3 pillow)" >&2
    fi
fi

if is_wanted make_models; then cp "$root/assets/jelly.png" "$out/make_models.png"; fi

# Those who need somebody else there.
serve() { # log, binary, arguments: starts it and leaves its invite in $invite
    local log="$1" pid
    shift
    "$@" >"$log" 2>&1 &
    pid=$!
    pids+=("$pid")
    while kill -0 "$pid" 2>/dev/null; do
        invite="$(grep -o 'pliant://[^ ]*' "$log" | head -n 1 || true)"
        [ -z "$invite" ] || return 0
        sleep 0.1
    done
    cat "$log" >&2
    return 1
}
if is_wanted host; then
    # A host with a guest in its session. The key and the port are those of a first, short run, so
    # that the guest has the invite before the host is there.
    key="$work/host.key"
    serve "$work/first.log" "$BIN/host" --headless --seconds 1 --bind 127.0.0.1:0 --key "$key"
    wait "${pids[-1]}"
    address="${invite#pliant://}"
    "$BIN/join" "$invite" --headless --cached --seconds 600 >"$work/guest.log" 2>&1 &
    pids+=($!)
    picture host host --bind "${address%%#*}" --key "$key"
fi
if is_wanted join || is_wanted dedicated_server; then
    serve "$work/server.log" "$BIN/dedicated_server" --bind 127.0.0.1:0 --play
    picture dedicated_server join "$invite" --cached --still --name "somebody who looks"
    picture join join "$invite" --cached --name guest
fi
if is_wanted shared_pile; then
    serve "$work/pile.log" "$BIN/shared_pile" --headless --seconds 600 --bind 127.0.0.1:0
    # A software renderer keeps up with the session at this size.
    picture shared_pile shared_pile --join "$invite" --size 896x504
fi
if is_wanted peers; then
    serve "$work/peer.log" "$BIN/peers" --headless --seconds 600 --name one
    picture peers peers "$invite" --name two
fi
