#!/usr/bin/env bash
# Installs the real `ros2` and `launch` into an environment with the ROS 2 wheels, which bring none of
# it: install_upstream_tools.sh ENV UPSTREAM MESSAGES. UPSTREAM has archives of their repositories.
# Builds this package there by colcon, as users have it. Afterwards source ENV/setup.bash.
set -euo pipefail

env=$(cd "$1" && pwd)
upstream=$2
messages=$(cd "$3" && pwd)
root=$(cd "$(dirname "$0")/.." && pwd)
unset LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH AMENT_PREFIX_PATH
version=$("$env/bin/python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
site=$env/lib/$version/site-packages

# The tools, once.
if [ ! -e "$env/bin/ros2" ]; then
    rm -rf "$env/upstream"
    mkdir "$env/upstream"
    for archive in launch launch_ros ros2cli rosidl_runtime_py; do
        tar -xzf "$upstream/$archive.tar.gz" -C "$env/upstream"
    done
    cd "$env/upstream"
    "$env/bin/python" -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation \
        ./rosidl_runtime_py ./launch/launch{,_xml,_yaml} ./launch_ros/{launch_ros,ros2launch} \
        ./ros2cli/ros2{pkg,run,node,topic,param,service,action,lifecycle,interface} ./ros2cli/ros2cli
    # Containers of components need these; launch_ros imports them whatever it starts.
    mkdir -p "$site/composition_interfaces"
    echo "class LoadNode: Request = Response = None
ListNodes = UnloadNode = LoadNode" >"$site/composition_interfaces/srv.py"
    touch "$site/composition_interfaces/__init__.py"
fi

# This package, in a workspace; from the files of now.
mkdir -p "$env/workspace"
cd "$env/workspace"
AMENT_PREFIX_PATH=$env "$env/bin/colcon" --log-base log build --paths "$root" >build.log 2>&1 ||
    { tail -n 30 build.log >&2; exit 1; }

cat >"$env/setup.bash" <<END
unset LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH=$env PATH=$env/bin:\$PATH
source $env/workspace/install/setup.bash
source $messages/setup.bash
END
