#!/usr/bin/env bash
# Run this checkout's HEAD on a bare Debian: python3, python3-venv, make and git, and no compiler.
#
#     sudo scripts/bare_root.sh bookworm            # Debian 12, Python 3.11: make demo
#     sudo scripts/bare_root.sh trixie demo test    # Debian 13, Python 3.13: make demo, make test
#     sudo scripts/bare_root.sh trixie -- make venv # any command, run in the clone
#
# Needs debootstrap. Variables: BARE_ROOT, a folder for the root that is kept and used again (else one is made
# below TMPDIR and removed); BARE_MIRROR, Debian's mirror; BARE_SHARE, folders separated by spaces that are
# mounted read-only at the same paths, such as assets. Proxies, pip's variables and DATAGEN_ASSETS are passed
# on.
set -euo pipefail

suite=${1:?name a release: bookworm or trixie}
shift
checkout=$(cd "$(dirname "$0")/.." && pwd)
mirror=${BARE_MIRROR:-http://deb.debian.org/debian}
[ "$(id -u)" -eq 0 ] || { echo "error: only root can make a root: sudo $0 $suite" >&2; exit 2; }
command -v debootstrap > /dev/null || { echo "error: no debootstrap here: apt-get install debootstrap" >&2; exit 2; }

root=${BARE_ROOT:-}
if [ -z "$root" ]; then
    root=$(mktemp -d)
    trap 'rm -rf --one-file-system "$root"' EXIT
fi
if [ ! -e "$root/etc/debian_version" ]; then
    echo "making a root of $suite in $root"
    debootstrap --variant=minbase --include=ca-certificates,git,make,python3,python3-venv \
        "$suite" "$root" "$mirror" > "$root.log" 2>&1 || { tail -n 5 "$root.log" >&2; exit 1; }
    rm -f "$root.log"
fi

clone=$root/srv/datagen
rm -rf "$clone"
git clone --quiet --no-hardlinks "$checkout" "$clone"
# The host's network settings: name resolution and trusted certificate authorities.
cp /etc/resolv.conf "$root/etc/resolv.conf"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"

if [ "${1:-}" = -- ]; then
    shift
    command=$(printf '%q ' "$@")
else
    command="make ${*:-demo}"
fi
passed=()
while IFS= read -r -d '' variable; do
    case $variable in
        [Hh][Tt][Tt][Pp]_[Pp]* | [Hh][Tt][Tt][Pp][Ss]_* | [Nn][Oo]_[Pp]* | PIP_* | SSL_CERT_* | DATAGEN_ASSETS=*)
            passed+=("$variable") ;;
    esac
done < /proc/self/environ

echo "$suite: $command"
# A new namespace: mounts and processes end with it. The quoted variables belong to the inner shell.
# shellcheck disable=SC2016
ROOT=$root SHARE=${BARE_SHARE:-} unshare --mount --pid --fork bash -euc '
    mount --make-rprivate /
    mount -t proc proc "$ROOT/proc"
    mount --rbind /dev "$ROOT/dev"
    for folder in $SHARE; do
        mkdir -p "$ROOT$folder"
        mount --bind -o ro "$folder" "$ROOT$folder"
    done
    exec chroot "$ROOT" "$@"
' bare /usr/bin/env -i HOME=/root LANG=C.UTF-8 PATH=/usr/sbin:/usr/bin:/sbin:/bin TERM="${TERM:-dumb}" \
    "${passed[@]}" bash -c "cd /srv/datagen && $command"
