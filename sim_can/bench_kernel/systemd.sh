# Sourced by init.sh: systemd as PID 1 of the guest. It boots to basic.target without anything that the host has enabled,
# runs command.sh as jtqd-bench.service, and switches off when that has ended.
rm -rf /etc/systemd/system/*.wants /etc/systemd/system/*.requires
[ -s /etc/machine-id ] || echo 0123456789abcdef0123456789abcdef >/etc/machine-id
mkdir -p /run/systemd/system /run/systemd/journald.conf.d
cat >/run/systemd/system/jtqd-bench.target <<END
[Unit]
Description=The bench kernel's command under systemd
Requires=basic.target
After=basic.target
Wants=jtqd-bench.service dbus.service
END
cat >/run/systemd/system/jtqd-bench.service <<END
[Unit]
Description=Command of the bench kernel
After=basic.target dbus.service
[Service]
Type=oneshot
TimeoutStartSec=infinity
ExecStart=/bin/sh "$JTQD_JOB/command.sh"
StandardInput=null
StandardOutput=append:$JTQD_JOB/stdout
StandardError=append:$JTQD_JOB/stderr
ExecStopPost=/bin/sh -c 'sync; echo \$\$EXIT_STATUS >$JTQD_JOB/status.part; mv $JTQD_JOB/status.part $JTQD_JOB/status; sync; systemctl --force --force poweroff'
END
cat >/run/systemd/journald.conf.d/bench.conf <<END
[Journal]
Storage=volatile
RateLimitIntervalSec=0
ForwardToConsole=no
END
for unit in systemd-networkd systemd-resolved systemd-timesyncd networking ModemManager apparmor keyboard-setup console-setup \
    systemd-modules-load systemd-tmpfiles-setup systemd-tmpfiles-setup-dev systemd-update-utmp; do
    ln -sf /dev/null "/run/systemd/system/$unit.service"
done
unset PATH
exec /lib/systemd/systemd --unit=jtqd-bench.target --log-target=journal-or-kmsg --show-status=no
