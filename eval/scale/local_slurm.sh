#!/usr/bin/env bash
# A real Slurm on this machine: a controller and two node daemons, as Slurm's documentation describes for tests
# (https://slurm.schedmd.com/programmer_guide.html, "Multiple slurmd support"). For root, on Debian or Ubuntu after
#
#     apt-get install slurm-wlm
#
#     eval/scale/local_slurm.sh start DIR     # then: export SLURM_CONF=DIR/slurm.conf
#     eval/scale/local_slurm.sh stop DIR
set -euo pipefail

start() {
  mkdir -p "$folder"/{state,spool,log} /run/munge
  chown munge /run/munge
  [ -f /etc/munge/munge.key ] || { dd if=/dev/urandom of=/etc/munge/munge.key bs=1 count=1024 status=none; }
  chown munge /etc/munge/munge.key && chmod 400 /etc/munge/munge.key
  pgrep -x munged >/dev/null || runuser -u munge -- munged
  cat >"$folder/slurm.conf" <<CONF
ClusterName=local
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SlurmdParameters=config_overrides
KillWait=2
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool/%n
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd-%n.pid
SlurmctldLogFile=$folder/log/slurmctld.log
SlurmdLogFile=$folder/log/slurmd-%n.log
SlurmctldPort=16817
NodeName=one NodeAddr=127.0.0.1 NodeHostname=$(hostname -s) Port=16821 CPUs=2 RealMemory=6000 State=UNKNOWN
NodeName=two NodeAddr=127.0.0.1 NodeHostname=$(hostname -s) Port=16822 CPUs=2 RealMemory=6000 State=UNKNOWN
PartitionName=cpu Nodes=one,two Default=YES MaxTime=INFINITE State=UP
CONF
  export SLURM_CONF=$folder/slurm.conf
  slurmctld
  for node in one two; do
    mkdir -p "$folder/spool/$node"
    slurmd -N "$node"
  done
  for _ in $(seq 30); do
    if [ "$(sinfo --noheader --format %T | sort -u)" = idle ]; then
      break
    fi
    sleep 1
  done
  sinfo
}

stop() {
  export SLURM_CONF=$folder/slurm.conf
  scancel --full --signal=KILL --user "$(id -un)" || true
  scontrol shutdown || true
}

folder=$(mkdir -p "$2" && cd "$2" && pwd)
"$1"
