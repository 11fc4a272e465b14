#!/bin/sh
# Boots systemd as the first process of namespaces of its own, and installs and runs the service there. Its root is an
# overlay of this computer's that goes with the namespaces: nothing outside FOLDER can be changed, /tmp included.
# usage: under_systemd.sh FOLDER PYTHON_PREFIX SITE_PACKAGES CODE [install's options]
set -eu
folder=$1 prefix=$2 site=$3 code=$4
shift 4
exec >"$folder/boot.log" 2>&1
mount --make-rprivate /
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
cd /mnt/root
mount -t proc proc proc
# A boot sets what the kernel is told to: not this one.
mount -o bind,ro proc/sys proc/sys
mount --bind /dev dev
mount --bind /dev/pts dev/pts
mount -t tmpfs tmpfs dev/shm
mount -t sysfs -o ro sysfs sys
mount -t tmpfs tmpfs sys/fs/cgroup
mkdir sys/fs/cgroup/systemd
mount -t cgroup -o none,name=systemd cgroup sys/fs/cgroup/systemd
mount -t tmpfs tmpfs run
mount -t tmpfs tmpfs tmp
# Where the service may see them: it sees neither home folders nor /tmp.
mkdir -p run/exchange opt/python opt/site opt/code opt/shearloop/bin
mount --bind "$folder" run/exchange
for pair in "$prefix python" "$site site" "$code code"; do
    mount --bind "${pair% *}" "opt/${pair##* }"
    mount -o remount,bind,ro "opt/${pair##* }"
done
mkdir run/before
pivot_root . run/before
umount -l /run/before
cat >/opt/shearloop/bin/shearloop <<RUN
#!/bin/sh
export PYTHONPATH=/opt/code/src:/opt/site LD_LIBRARY_PATH=/opt/python/lib
exec /opt/python/bin/python3 -m shearloop "\$@"
RUN
chmod +x /opt/shearloop/bin/shearloop
/opt/shearloop/bin/shearloop install --program /opt/shearloop/bin/shearloop "$@"
cp /run/exchange/shearloop.yaml /etc/shearloop/
cp /run/exchange/tiny.bank /var/lib/shearloop/banks/
mkdir -p /etc/systemd/system/shearloop.service.d
printf '[Service]\nWatchdogSec=2\nRestartSec=0\nTimeoutAbortSec=2\n' >/etc/systemd/system/shearloop.service.d/quick.conf
cat >/etc/systemd/system/probe.service <<UNIT
[Service]
Type=oneshot
ExecStart=/bin/sh /run/exchange/probe.sh
UNIT
export container=docker
exec /lib/systemd/systemd --system --unit=probe.service --log-target=null </dev/null
