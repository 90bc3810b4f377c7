#!/bin/sh
# The swarm of compose.yaml by podman (or docker) alone: keys, simulator, three drones, judge. Exit code: the judge's.
#
#     docker/run-by-hand.sh                    # with the image `swarmtrack`, built before
#
# Three detectors and three rendered cameras want two free cores. With DETECTOR=oracle the simulator sends detections instead
# of images, and a busy machine does. ENGINE: another command, such as `docker` or `podman --runtime runc`. RUN_OPTIONS: more options of every `run`.
set -eu

engine=${ENGINE:-podman}
image=${IMAGE:-swarmtrack}
seconds=${SECONDS_TO_JUDGE:-20}
detector=${DETECTOR:-onnx}
configs=$(cd "$(dirname "$0")" && pwd)/swarm
name=swarmtrack-$$                     # of the network and the volume, and what our containers' names begin with

scratch=$(mktemp -d)

clean_up() {
    rm -rf "$scratch"
    for each in judge drone-1 drone-2 drone-3 simulator; do
        $engine rm --force "$name-$each" >/dev/null 2>&1 || true
    done
    $engine volume rm --force "$name" >/dev/null 2>&1 || true
    $engine network rm --force "$name" >/dev/null 2>&1 || true
}
trap clean_up EXIT
trap 'exit 130' INT TERM

# $1: its name on the network; the rest: options, image and command.
start() {
    who=$1
    shift
    # shellcheck disable=SC2086
    $engine run --name "$name-$who" --hostname "$who" --network "$name" --network-alias "$who" \
        --read-only --tmpfs /tmp --cap-drop all --security-opt no-new-privileges ${RUN_OPTIONS:-} "$@"
}

# Docker starts health checks by itself; podman leaves that to systemd, which a container host may lack.
wait_until_healthy() {
    tries=0
    until [ "$($engine inspect --format '{{.State.Health.Status}}' "$name-$1" 2>/dev/null)" = healthy ] ||
        { [ "${engine#*podman}" != "$engine" ] && $engine healthcheck run "$name-$1" >/dev/null 2>&1; }; do
        tries=$((tries + 1))
        if [ "$tries" -gt 60 ]; then
            echo "$1 did not become healthy; its log:" >&2
            $engine logs --tail 20 "$name-$1" >&2
            exit 1
        fi
        sleep 1
    done
    echo "$1 is healthy"
}

if [ "$detector" = oracle ]; then
    for file in "$configs"/*.toml; do
        sed 's#"http://simulator#"detections://simulator#' "$file" >"$scratch/${file##*/}"
    done
    chmod -R a+rX "$scratch"
    configs=$scratch
fi

$engine network create "$name" >/dev/null
$engine volume create "$name" >/dev/null

# shellcheck disable=SC2086
$engine run --rm --network none --read-only --tmpfs /tmp --cap-drop all --security-opt no-new-privileges \
    ${RUN_OPTIONS:-} --volume "$name:/keys" --entrypoint /bin/sh "$image" -euc '
        swarmtrack keys init /keys --team compose
        swarmtrack keys issue /keys 1 2 3 monitor'

start simulator --detach \
    --health-cmd 'python -c "import urllib.request; urllib.request.urlopen(\"http://127.0.0.1:8100/\", timeout=3)"' \
    --entrypoint python "$image" -m swarmtrack.agents.simulator \
    --scenario hover-triangle --detector "$detector" --host 0.0.0.0 --port 8100 >/dev/null
wait_until_healthy simulator

for drone in 1 2 3; do
    start "drone-$drone" --detach --volume "$configs:/etc/swarmtrack:ro" --volume "$name:/keys:ro" \
        "$image" --config "/etc/swarmtrack/drone-$drone.toml" --quiet >/dev/null
done
for drone in 1 2 3; do wait_until_healthy "drone-$drone"; done

verdict=0
start judge --no-healthcheck --volume "$configs:/etc/swarmtrack:ro" --volume "$name:/keys:ro" \
    --entrypoint swarmtrack "$image" judge http://simulator:8100 --seconds "$seconds" \
    --config /etc/swarmtrack/team.toml --keys /keys/monitor || verdict=$?
for drone in 1 2 3; do
    echo "drone-$drone: $($engine exec "$name-drone-$drone" swarmtrack healthy || true)"
done
exit "$verdict"
