#!/bin/sh
# Runs the job of the host, /mnt/job/command, in a copy of the project and leaves its output and exit code beside it.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8 PYTHONUNBUFFERED=1 PYTHONPATH=/opt/omnid
echo "[guest] up after $(cut -d' ' -f1 /proc/uptime) s"
cp -r /mnt/job/tree /opt/omnid
cd /opt/omnid || exit 1
sh /mnt/job/command >/mnt/job/output 2>&1 </dev/null
echo $? >/mnt/job/code
sync
echo "[guest] done after $(cut -d' ' -f1 /proc/uptime) s"
busybox poweroff -f
