#!/bin/sh
# Installs jtqd into a virtual environment of its own with its units, or takes it away again. May be run again at any time:
# what is there is brought up to date, what an operator has edited (/etc/jtqd) is never touched.
set -eu

usage() {
    cat <<'END'
usage: install.sh [--source DIR|WHEEL] [--prefix DIR] [--python PYTHON] [--wheels DIR] [--prepared] [--interface IF]...
                  [--enable]
       install.sh --uninstall [--purge] [--prefix DIR]

  --source     this project's directory, or a wheel of it (default: the directory above this script)
  --prefix     where the virtual environment goes (default: /opt/jtqd; the units name it)
  --python     interpreter, 3.11 or newer, that every user can run (default: python3)
  --wheels     take every package from this directory and nothing from the network
  --prepared   the environment is there already (an image, a package): only units, user and directories
  --interface  make /etc/jtqd/IF.yaml and IF.link from the files that ship, unless they are there
  --enable     start jtqd with each --interface, now and at every boot
  --uninstall  stop and remove units and environment; with --purge also /etc/jtqd, /var/log/jtqd and the user

examples:
  systemd/install.sh --interface can0                     install; then edit /etc/jtqd/can0.yaml
  systemctl enable --now jtqd@can0 can-up@can0            start it with the interface
  systemd/install.sh --wheels /media/usb/wheels           a controller without network
  pip download --dest wheels . setuptools                 fills such a directory, on a machine of the same kind
END
}

fail() {
    echo "install.sh: $1" >&2
    exit "${2:-1}"
}

here=$(cd "$(dirname "$0")" && pwd)
source=$(dirname "$here") prefix=/opt/jtqd python=python3 wheels='' interfaces='' enable='' prepared='' uninstall='' purge=''
while [ $# -gt 0 ]; do
    case $1 in
    --source) source=${2:?} && shift ;;
    --prefix) prefix=${2:?} && shift ;;
    --python) python=${2:?} && shift ;;
    --wheels) wheels=${2:?} && shift ;;
    --interface) interfaces="$interfaces ${2:?}" && shift ;;
    --enable) enable=1 ;;
    --prepared) prepared=1 ;;
    --uninstall) uninstall=1 ;;
    --purge) purge=1 ;;
    -h | --help) usage && exit 0 ;;
    *) usage >&2 && fail "unknown argument $1" 2 ;;
    esac
    shift
done
[ "$(id -u)" = 0 ] || fail "must be run as root"
units=/etc/systemd/system
managed() { [ -d /run/systemd/system ]; }

if [ -n "$uninstall" ]; then
    if managed; then
        systemctl stop 'jtqd@*.service' 'can-up@*.service' || true
        for unit in jtqd can-up; do
            for link in "$units"/*.wants/"$unit"@*.service; do [ ! -L "$link" ] || rm -f "$link"; done
        done
    fi
    rm -rf "$units/jtqd@.service" "$units/can-up@.service" /etc/sysusers.d/jtqd.conf /etc/tmpfiles.d/jtqd.conf \
        /etc/sysctl.d/60-jtqd.conf "$prefix"
    if [ -n "$purge" ]; then
        rm -rf /etc/jtqd /var/log/jtqd /run/jtqd
        ! id jtqd >/dev/null 2>&1 || userdel jtqd
        ! getent group jtqd >/dev/null || groupdel jtqd
    fi
    ! managed || systemctl daemon-reload
    echo "install.sh: removed${purge:+ with configuration, logs and user}"
    exit 0
fi

[ -z "$prepared" ] || { [ -x "$prefix/bin/jtqd" ] && python=$prefix/bin/python; } || fail "$prefix: no jtqd is there"
real=$("$python" -c 'import sys; print(sys.base_prefix)') || fail "$python: cannot be run"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || fail "$python: older than 3.11"
case $real in
/root/* | /home/* | /run/user/*) fail "$python lives in $real, which the service must not see (ProtectHome=yes)" ;;
esac
if [ -z "$prepared" ]; then
    [ -x "$prefix/bin/python" ] || "$python" -m venv "$prefix"
    set -- --disable-pip-version-check --quiet install --upgrade
    [ -z "$wheels" ] || set -- "$@" --no-index --find-links "$wheels"
    "$prefix/bin/python" -m pip "$@" "$source"
fi

install -d -m 755 "$units" /etc/sysusers.d /etc/tmpfiles.d /etc/sysctl.d /etc/jtqd
install -m 644 "$here/jtqd@.service" "$here/can-up@.service" "$units/"
if [ "$prefix" != /opt/jtqd ]; then sed -i "s|/opt/jtqd|$prefix|g" "$units/jtqd@.service"; fi
install -m 644 "$here/jtqd.sysusers.conf" /etc/sysusers.d/jtqd.conf
install -m 644 "$here/jtqd.tmpfiles.conf" /etc/tmpfiles.d/jtqd.conf
install -m 644 "$here/jtqd.sysctl.conf" /etc/sysctl.d/60-jtqd.conf
systemd-sysusers /etc/sysusers.d/jtqd.conf
systemd-tmpfiles --create /etc/tmpfiles.d/jtqd.conf
sysctl -q -e -p /etc/sysctl.d/60-jtqd.conf || echo "install.sh: sysctl: some settings were refused" >&2

# The shipped configuration keeps every log. A controller's keeps the newest: half of what is free among its interfaces, and
# not more than 20 GB (a day) each.
half='import shutil, sys; print(max(1000, min(20000, shutil.disk_usage("/var/log").free // 2_000_000 // len(sys.argv[1:]))))'
budget_mb=${interfaces:+$("$prefix/bin/python" -c "$half" $interfaces)}
shipped=$(cd / && "$prefix/bin/python" -c 'import jtqd.models, os; print(os.path.dirname(jtqd.models.__file__))')
for interface in $interfaces; do
    file=/etc/jtqd/$interface.yaml
    if [ ! -e "$file" ]; then
        cp -r "$shipped/trained" /etc/jtqd/
        sed "s/^recording: .*/recording: {budget_mb: $budget_mb, keep_run: false}/" "$shipped/bench.yaml" >"$file"
        chmod 644 "$file"
    fi
    link=/etc/jtqd/$interface.link
    [ -e "$link" ] || case $interface in
    vcan*) echo BITRATE=none >"$link" ;;
    *) printf 'BITRATE=1000000\nRESTART_MS=100\nTXQUEUELEN=1000\nOPTIONS="berr-reporting on"\n' >"$link" ;;
    esac
done
if managed; then
    systemctl daemon-reload
    for interface in ${enable:+$interfaces}; do systemctl enable --now "can-up@$interface" "jtqd@$interface"; done
fi
version=$(cd / && "$prefix/bin/python" -c 'import jtqd; print(jtqd.__version__)')
echo "install.sh: jtqd $version in $prefix"
