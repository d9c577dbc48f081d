#!/usr/bin/env bash
# Starts a SLURM of one node on this machine, from the distribution's packages (slurm-wlm, munge):
#   start_slurm.sh FOLDER START_PORT     then use it with SLURM_CONF=FOLDER/slurm.conf
# Prints the reason on standard error, and ends with 1, where it cannot start.
set -euo pipefail
folder=$1 port=$2
for program in munged slurmctld slurmd sbatch; do
    command -v "$program" > /dev/null || { echo "no $program: install slurm-wlm and munge" >&2; exit 1; }
done
[[ $(id -u) == 0 ]] || { echo "SLURM's daemons need root" >&2; exit 1; }
mkdir -p "$folder/state" "$folder/spool"
node=$(hostname -s)
cat > "$folder/slurm.conf" << CONF
ClusterName=tests
SlurmctldHost=$node(127.0.0.1)
SlurmctldPort=$port
SlurmdPort=$((port + 1))
AuthType=auth/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
NodeName=$node NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(($(sed -n "s/^MemTotal: *\([0-9]*\) kB/\1/p" /proc/meminfo) / 1100)) State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP OverSubscribe=FORCE:8
CONF
if ! munge -n < /dev/null > /dev/null 2>&1; then
    mkdir -p /run/munge && chown munge: /run/munge
    runuser -u munge -- munged
fi
export SLURM_CONF=$folder/slurm.conf
slurmctld
slurmd
for _ in $(seq 60); do
    sinfo -h -o %t 2> /dev/null | grep -qE '^(idle|mix)$' && exit 0
    sleep 0.5
done
{ sinfo; tail -n 5 "$folder"/*.log; } >&2
exit 1
