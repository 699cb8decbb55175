#!/bin/sh
# PID 1 of the bench kernel's guest. The kernel command line hands over, as environment:
#   JTQD_JOB     directory of the host: holds command.sh and `out`, a list of directories, one per line, that are
#                written through to the host; receives stdout, stderr and status
#   JTQD_VCANS   names of the interfaces, separated by commas
#   JTQD_PYTHON  interpreter, needed to switch off where there is no `halt`
#   JTQD_SYSTEMD when it is 1, systemd becomes PID 1 and runs the command as a unit (systemd.sh)
# Everything else the guest writes ends in a tmpfs above the host's files.
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PATH

power_off() {
    sync
    halt -f 2>/dev/null
    "$JTQD_PYTHON" -I -S -c 'import ctypes; ctypes.CDLL(None).reboot(0x4321FEDC)'
}

give_up() {
    echo "jtqd: guest set-up failed: $1" # to the console log
    power_off
}

if [ "$1" != inside ]; then
    mount -n -t proc proc /proc || give_up "mount /proc"
    mount -n -t tmpfs -o size=75% tmpfs /mnt || give_up "mount tmpfs on /mnt"
    mkdir /mnt/upper /mnt/work /mnt/root
    mount -n -t overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work overlay /mnt/root || give_up "mount overlay"
    cd /mnt/root || give_up "cd"
    mount -n -t proc proc proc && mount -n -t sysfs sysfs sys && mount -n -t devtmpfs devtmpfs dev &&
        mount -n -t tmpfs tmpfs run || give_up "mount proc, sysfs, devtmpfs, run"
    mkdir -p dev/shm dev/pts run/home run/lock
    mount -n -t tmpfs tmpfs dev/shm
    mount -n -t devpts devpts dev/pts
    ln -s /proc/self/fd dev/fd
    ln -s fd/0 dev/stdin
    ln -s fd/1 dev/stdout
    ln -s fd/2 dev/stderr
    # Option sync: a write is on the host when the system call returns, so that output can be followed.
    mkdir -p ".$JTQD_JOB"
    mount -n -t hostfs -o "sync,$JTQD_JOB" none ".$JTQD_JOB" || give_up "mount $JTQD_JOB"
    while IFS= read -r out; do
        mkdir -p ".$out"
        mount -n --bind "$out" ".$out" || give_up "bind $out"
    done <"$JTQD_JOB/out"
    mount -n --move . / || give_up "move the root"
    exec chroot . /bin/sh "$0" inside
fi

cd /
echo bench >/proc/sys/kernel/hostname
# No throttling of SCHED_FIFO. This kernel's scheduler clock moves in ticks of 10 ms: a loop that happens to be running
# at every tick is charged with all of the time, although it works for microseconds, and would be stopped for 50 ms a second.
echo -1 >/proc/sys/kernel/sched_rt_runtime_us || give_up "sched_rt_runtime_us"
ip link set lo up
for name in $(echo "$JTQD_VCANS" | tr , ' '); do
    ip link add dev "$name" type vcan && ip link set "$name" txqueuelen 1000 up || give_up "ip link add $name"
done
if [ "$JTQD_SYSTEMD" = 1 ]; then
    . "${0%/*}/systemd.sh"
    give_up "systemd did not start"
fi
/bin/sh "$JTQD_JOB/command.sh" </dev/null >"$JTQD_JOB/stdout" 2>"$JTQD_JOB/stderr"
status=$?
sync
echo $status >"$JTQD_JOB/status.part"
mv "$JTQD_JOB/status.part" "$JTQD_JOB/status"
power_off
