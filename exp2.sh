. /tmp/s15/env.sh /tmp/s15/sigma; cd /tmp/s15/sigma-scratch/exp; export PYTHONPATH=$PWD/src
nice -n 10 $V/python benchmarks/sensor_models.py --seeds 0 1 --width 320 --variants none tracking --sources redkitchen=base:0.0012,z2:0.0015:120 hololens=base:0.0012,z1:0.0005,z2:0.00025:60 --out /tmp/s15/sigma-scratch --name pilot2
