#!/usr/bin/env bash
# Starts a SLURM of two nodes on this machine, from the distribution's packages (slurm-wlm, munge),
# each a slurmd with a port of its own, of one processor:
#   start_slurm.sh FOLDER START_PORT     then use it with SLURM_CONF=FOLDER/slurm.conf
# Prints the reason on standard error, and ends with 1, where it cannot start.
set -euo pipefail
folder=$1 port=$2
for program in munged slurmctld slurmd sbatch; do
    command -v "$program" > /dev/null || { echo "no $program: install slurm-wlm and munge" >&2; exit 1; }
done
[[ $(id -u) == 0 ]] || { echo "SLURM's daemons need root" >&2; exit 1; }
mkdir -p "$folder/state"
host=$(hostname -s)
cat > "$folder/slurm.conf" << CONF
ClusterName=tests
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$port
AuthType=auth/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool-%n
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd-%n.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
NodeName=DEFAULT CPUs=1 RealMemory=1000 State=UNKNOWN
NodeName=node1 NodeHostname=$host NodeAddr=127.0.0.1 Port=$((port + 1))
NodeName=node2 NodeHostname=$host NodeAddr=127.0.0.1 Port=$((port + 2))
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
if ! munge -n < /dev/null > /dev/null 2>&1; then
    mkdir -p /run/munge && chown munge: /run/munge
    runuser -u munge -- munged
fi
export SLURM_CONF=$folder/slurm.conf
slurmctld
slurmd -N node1
slurmd -N node2
for _ in $(seq 60); do
    (($(sinfo -h -N -t idle -o %N 2> /dev/null | wc -l) == 2)) && exit 0
    sleep 0.5
done
{ sinfo -N; cat "$folder"/*.log | tail -n 15; } >&2
exit 1
