#!/usr/bin/env bash
# Makes all pictures of the window in docs/ anew.
#
#   docs/pictures.sh VOLUMES [ISINGLASS] [NAME…]
#
# VOLUMES is a folder with avm.nrrd, bonsai.nrrd, heptane.nrrd and mouse_brain.nrrd. `tour` also takes engine.nrrd and
# t1_head.nrrd, and leaves out what is not there.
# docs/BENCHMARKS.md and docs/GUIDE.md name their origins. ISINGLASS is the program; without it a release build is made.
# NAMEs, such as viewer or guide-mip, select pictures. `tour` alone makes pictures to look at and not to keep, in
# target/tour: each kind of page, size and theme. The script needs Xvfb, xdotool, xwd and ImageMagick.
set -euo pipefail
cd "$(dirname "$0")/.."
[ $# -ge 1 ] || { sed -n '2,10p' "$0"; exit 2; }
volumes=$(realpath "$1")
program=${2:-}
chosen=" ${*:3} "
if [ -z "$program" ]; then
    cargo build --release
    program=${CARGO_TARGET_DIR:-target}/release/isinglass
fi
program=$(realpath "$program")

# A home of its own: the start window shows its files, and no settings of the developer count.
home=/tmp/me
mkdir "$home"
jobs_to_end=()
trap 'kill "${jobs_to_end[@]}" 2>/dev/null || true; rm -rf "$home"' EXIT
export HOME=$home XDG_RUNTIME_DIR=$home XDG_STATE_HOME=$home/state XDG_CONFIG_HOME=$home/config
mkfifo "$home/display"
exec 3<>"$home/display"
mkdir "$home/scans"
wanted=(avm.nrrd bonsai.nrrd heptane.nrrd mouse_brain.nrrd)
[ "$chosen" != " tour " ] || wanted+=(engine.nrrd t1_head.nrrd)
for name in "${wanted[@]}"; do
    found=$(find "$volumes" -name "$name" | head -n 1)
    if [ -n "$found" ]; then
        cp "$found" "$home/scans/"
    elif [ "$chosen" != " tour " ]; then
        echo "$volumes has no $name" >&2
        exit 1
    fi
done

# The bonsai upright, from aside and a little above; without the table that the scanner saw below it.
cat >"$home/bonsai.toml" <<'STATE'
isinglass_state = 1
[camera]
center = [0.0, 0.0, -8.0]
rotation = [-0.15933, 0.57523, 0.77321, -0.21417]
eye_from_center = [-30.0, 0.0, 400.0]
fov_degrees = 40.0
size = [1100, 760]
STATE
bonsai=(bonsai.nrrd --state "$home/bonsai.toml" --clip-box=-88,88,-128,120,-104,128 --ambient-occlusion 0.5 --shadows 0.4)

# open WxH ARGUMENTS…: a display of that size with the program's window.
open() {
    local size=$1
    shift
    # Without `-noreset`, a server starts anew whenever its last client leaves.
    Xvfb -noreset -displayfd 3 -screen 0 "${size}x24" >/dev/null 2>&1 &
    jobs_to_end+=($!)
    read -r number <&3
    export DISPLAY=:$number
    (cd "$home/scans" && exec "$program" "$@") >"$home/log" 2>&1 &
    jobs_to_end+=($!)
}

# Ends the program and its display.
close() {
    kill "${jobs_to_end[@]}"
    wait "${jobs_to_end[@]}" 2>/dev/null || true
    jobs_to_end=()
}

# Whether the badge has the colour of a picture that becomes better, in the dark or the light theme.
is_refining() {
    local color scale=${WINIT_X11_SCALE_FACTOR:-1}
    local size=$((242 * scale))x$((40 * scale))
    for color in 'rgb(110,175,245)' 'rgb(18,88,176)'; do
        import -window root -crop "$size+$((10 * scale))+$((45 * scale))" rgb:- |
            convert -size "$size" -depth 16 rgb:- -depth 8 -fill black +opaque "$color" -format '%k' info: |
            grep -qx 1 || return 0
    done
    return 1
}

# Waits until the window has not changed for ten seconds, and is not black. The status line may tell another round trip.
settle() {
    local before="" now same=0
    for _ in $(seq 150); do
        sleep 2
        kill -0 "${jobs_to_end[1]}" || { cat "$home/log"; exit 1; }
        now=$(import -window root -gravity southeast -crop 80x70%+0+28 rgb:- | md5sum)
        if [ "$now" = "$before" ]; then same=$((same + 1)); else same=0; fi
        before=$now
        if [ $same -ge 5 ] && [ "$(import -window root -format '%k' info:)" -gt 64 ] && ! is_refining; then return; fi
    done
    echo "the picture never came to rest" >&2
    exit 1
}

# act KEYS: presses each of KEYS, and waits for the window after the last. X,Y is a click there.
act() {
    for key in $1; do
        case $key in
        *,*) xdotool mousemove "${key%,*}" "${key#*,}" sleep 0.5 click 1 ;;
        *) xdotool search --onlyvisible --name isinglass windowfocus key "$key" ;;
        esac
        sleep 1
    done
    [ -z "$1" ] || settle
}

# picture NAME KEYS ARGUMENTS…: the window at rest, after KEYS.
picture() {
    local name=$1 keys=$2
    shift 2
    [[ $chosen == "  " || $chosen == *" $name "* ]] || return 0
    open 1100x760 "$@"
    settle
    act "$keys"
    import -window root -depth 8 -strip "docs/$name.png"
    close
    echo "docs/$name.png"
}

# look NAME WxH KEYS ARGUMENTS…: the window at rest in target/tour, after KEYS.
look() {
    local name=$1 size=$2 keys=$3
    shift 3
    open "$size" "$@" --size "$size"
    settle
    act "$keys"
    import -window root -depth 8 -strip "target/tour/$name.png"
    close
    echo "target/tour/$name.png"
}

# tour: what a user meets, page by page.
tour() {
    mkdir -p target/tour
    look start 1100x760 "" view
    for volume in avm bonsai engine heptane mouse_brain t1_head; do
        [ -e "$home/scans/$volume.nrrd" ] || continue
        look "first-$volume" 1280x800 "" view "$volume.nrrd" --backend cpu
    done
    look slices 1280x800 x view avm.nrrd --backend cpu
    look measure 1280x800 "d 430,400 530,480" view bonsai.nrrd --backend cpu
    look help 1280x800 h view bonsai.nrrd --backend cpu
    for theme in dark light; do
        look "$theme" 1280x800 "" view bonsai.nrrd --backend cpu --theme "$theme"
        look "small-$theme" 700x500 "" view bonsai.nrrd --backend cpu --theme "$theme"
    done
    WINIT_X11_SCALE_FACTOR=2 look double 1400x1000 "" view bonsai.nrrd --backend cpu
}

# moving NAME ARGUMENTS…: a drag to both sides and back, in real time, until the first picture is there again.
moving() {
    local name=$1
    shift
    [[ $chosen == "  " || $chosen == *" $name.webp "* ]] || return 0
    open 640x420 "$@"
    settle
    xwd -root -silent -out "$home/still.xwd"
    xdotool mousemove 320 210 mousedown 1
    (
        for x in $(seq 320 3 500) $(seq 500 -3 200) $(seq 200 3 320); do
            xdotool mousemove "$x" $((210 + (x - 320) / 8))
            sleep 0.03
        done
        xdotool mouseup 1
    ) &
    local drag=$! shots=() times=() i=0 same=0
    while [ $same -lt 20 ] && [ $i -lt 200 ]; do
        xwd -root -silent -out "$home/$i.xwd"
        times+=("$(date +%s%3N)")
        if kill -0 $drag 2>/dev/null || ! cmp -s "$home/$i.xwd" "$home/still.xwd"; then same=0; else same=$((same + 1)); fi
        i=$((i + 1))
        sleep 0.06
    done
    for ((n = 0; n + 1 < i; n++)); do
        shots+=(-delay $(((times[n + 1] - times[n]) / 10)) "xwd:$home/$n.xwd")
    done
    convert -loop 0 "${shots[@]}" -quality 75 -define webp:method=6 "docs/$name.webp"
    close
    echo "docs/$name.webp"
}

if [ "$chosen" = " tour " ]; then
    tour
    exit
fi
picture viewer "" demo "${bonsai[@]}" --rtt 200ms --size 1100x760
moving viewer demo "${bonsai[@]}" --rtt 200ms --bars off --size 640x420
picture guide-start "" view
picture guide-editor "" view bonsai.nrrd --orbit 30,20,2 --backend cpu
picture guide-mip "" view avm.nrrd --mode mip --orbit 0,-70,2 --backend cpu
picture guide-iso "" demo "${bonsai[@]}" --rtt 50ms --mode iso --iso 40:0.3,120 --size 1100x760 --backend cpu
picture guide-light "" demo heptane.nrrd --rtt 50ms --orbit 30,20,2.1 --ambient-occlusion 0.8 --shadows 0.7 --backend cpu
picture guide-clip c view mouse_brain.nrrd --orbit 30,20,2 --clip-box=-20,20,-20,1,-20,20 --backend cpu
picture guide-measure "x d 217,718 480,85 660,85" view bonsai.nrrd --orbit 30,20,2 --backend cpu
