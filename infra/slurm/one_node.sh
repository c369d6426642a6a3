#!/usr/bin/env bash
# SLURM on this one machine, for trying things out: a partition "local" whose only node has as many CPUs as you say.
#
#     sudo apt-get install slurm-wlm munge
#     sudo bash infra/slurm/one_node.sh start 2     # CPUs, which need not be the machine's
#     sinfo; sbatch --wrap hostname; squeue
#     sudo bash infra/slurm/one_node.sh stop
#
# All its files are in /tmp/cat3d-slurm; the daemons listen on this machine's own addresses only.
set -euo pipefail
WHERE=/tmp/cat3d-slurm
export SLURM_CONF=$WHERE/slurm.conf

start() {
  mkdir -p $WHERE/state $WHERE/spool /run/munge /var/log/munge
  if ! munge -n </dev/null >/dev/null 2>&1; then
    [ -s /etc/munge/munge.key ] || { dd if=/dev/urandom of=/etc/munge/munge.key bs=1 count=1024 status=none; }
    chown -R munge: /etc/munge /run/munge /var/log/munge /var/lib/munge && chmod 400 /etc/munge/munge.key
    runuser -u munge -- /usr/sbin/munged
  fi
  cat >$SLURM_CONF <<CONF
ClusterName=cat3d
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
SlurmctldPidFile=$WHERE/slurmctld.pid
SlurmdPidFile=$WHERE/slurmd.pid
SlurmctldLogFile=$WHERE/slurmctld.log
SlurmdLogFile=$WHERE/slurmd.log
StateSaveLocation=$WHERE/state
SlurmdSpoolDir=$WHERE/spool
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=5
MpiDefault=none
NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=${1:-$(nproc)} RealMemory=$(awk '/MemTotal/ {print int($2 / 1024 / 2)}' /proc/meminfo)
PartitionName=local Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
  ln -sf $SLURM_CONF /etc/slurm/slurm.conf
  slurmctld -f $SLURM_CONF
  slurmd -f $SLURM_CONF
  for _ in $(seq 30); do
    if sinfo -h -t idle 2>/dev/null | grep -q .; then sinfo; return; fi
    sleep 1
  done
  echo "The node did not come up; see $WHERE/slurmctld.log and $WHERE/slurmd.log." >&2
  exit 1
}

stop() {
  for daemon in slurmd slurmctld; do
    if [ -s $WHERE/$daemon.pid ]; then kill "$(cat $WHERE/$daemon.pid)" || true; fi
  done
  rm -f /etc/slurm/slurm.conf
}

case "${1:-}" in
  start) start "${2:-}" ;;
  stop) stop ;;
  *) sed -n '2,10p' "$0"; exit 2 ;;
esac
