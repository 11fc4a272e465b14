# Run by systemd: what becomes of the service, a line `what: value` for each thing that is seen.
exec >"/run/exchange/seen" 2>&1
of() { systemctl show shearloop -p "$1" --value; }
# Waits until a property of the unit is so, for at most half a minute, and tells it.
until_so() {
    for _ in $(seq 300); do
        [ "$(of "$2")" = "$3" ] && break
        sleep 0.1
    done
    echo "$1: $(of "$2")"
}
systemctl start shearloop
echo "started: $?"
until_so alive StatusText "6 tasks are alive"
echo "user: $(of User)"
# Other daemons may run on this machine.
ls -l "/proc/$(of MainPID)/fd" >/run/files
echo "stop socket: $(awk '/@shearloop-stop-/ {print "socket:[" $7 "]"}' /proc/net/unix | grep -cFf - /run/files)"
echo "policy: $(chrt -p "$(of MainPID)" | grep -o 'SCHED_[A-Z]*')"
echo "capabilities: $(grep CapEff "/proc/$(of MainPID)/status" | cut -f2)"
if [ -e /run/exchange/start_only ]; then
    systemctl stop shearloop
    echo "stopped: $(of Result) $(of ExecMainStatus)"
    echo "end: 0"
    systemctl poweroff --force --force
fi
kill -KILL "$(of MainPID)"
until_so killed NRestarts 1
until_so again StatusText "6 tasks are alive"
# A daemon that hangs does not feed the watchdog.
kill -STOP "$(of MainPID)"
until_so hung NRestarts 2
until_so again StatusText "6 tasks are alive"
systemctl stop shearloop
echo "stopped: $(of Result) $(of ExecMainStatus)"
echo "fingertipz: 1" >>/etc/shearloop/shearloop.yaml
systemctl start shearloop
until_so mistaken ActiveState failed
echo "mistake: status $(of ExecMainStatus), $(of NRestarts) restarts"
echo "end: 0"
systemctl poweroff --force --force
