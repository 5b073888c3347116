#!/usr/bin/env bash
# Builds message packages over the ROS 2 wheels, where there are no wheels of them:
# build_messages.sh NICS FOLDER UPSTREAM. Those that `nics install` knows by name always; those whose
# sources lie in the folder UPSTREAM, as archives of their repositories, where it exists.
# Afterwards source FOLDER/setup.bash.
set -euo pipefail

nics=$1
mkdir -p "$2"
folder=$(cd "$2" && pwd)
upstream=$3

sources=(tf2_msgs ackermann_msgs)
mkdir -p "$folder/upstream"
for package in simulation_interfaces/simulation_interfaces nav2_interfaces/navigation2/nav2_msgs; do
    archive=$upstream/${package%%/*}.tar.gz
    if [ -e "$archive" ]; then
        tar -xzf "$archive" -C "$folder/upstream"
        sources+=("$folder/upstream/${package#*/}")
    else
        echo "${package##*/} is left out: there is no $archive"
    fi
done
"$nics" install --prefix "$folder" "${sources[@]}"
