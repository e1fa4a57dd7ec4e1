#!/usr/bin/env bash
# Say in one sentence what this machine lacks; where nothing is lacking, print the Python that will make .venv.
# Nothing is downloaded or written. PYTHON=<interpreter> overrules the choice.
set -euo pipefail

lacking() {
  echo "dae_ros: $1" >&2
  exit 1
}

# Run by a candidate on its standard input, so it must parse on any Python. Prints: state, version, interpreter.
probe='
import sys
version = "%d.%d" % sys.version_info[:2]
state = "ok"
if not (3, 10) <= sys.version_info[:2] <= (3, 13) or sys.implementation.name != "cpython":
    state = "version"
else:
    import os, sysconfig
    try:
        import ensurepip, venv
    except ImportError:
        state = "venv"
    if sysconfig.get_config_var("Py_GIL_DISABLED"):
        state = "version"
    elif state == "ok" and not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
        state = "headers"
# In a virtual environment: the interpreter it was made from, since .venv may be the one in use.
print("%s %s %s" % (state, version, getattr(sys, "_base_executable", sys.executable)))
'

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
case $root in
*[[:space:]]*) lacking "the path '$root' contains a space, which ROS's build tools cannot handle: move the folder." ;;
esac

# ROS: the sourced installation, or the wheels.
ros_python=
if [ -n "${ROS_DISTRO:-}" ] && [ -n "${AMENT_PREFIX_PATH:-}" ]; then
  [ "$ROS_DISTRO" = jazzy ] || lacking "ROS 2 $ROS_DISTRO is sourced in this shell, but dae_ros needs Jazzy: \
source Jazzy instead, or use a shell in which no ROS is sourced and let set-up install Jazzy's wheels."
  IFS=: read -ra prefixes <<<"$AMENT_PREFIX_PATH"
  for package in rclpy rosidl_default_generators rmw_fastrtps_cpp ament_cmake std_srvs diagnostic_msgs; do
    found=
    for prefix in "${prefixes[@]}"; do
      [ -e "$prefix/share/ament_index/resource_index/packages/$package" ] && found=yes && break
    done
    [ -n "$found" ] || lacking "the sourced ROS 2 Jazzy has no $package: install it, on Ubuntu with \
'sudo apt install ros-jazzy-${package//_/-}'."
  done
  for prefix in "${prefixes[@]}"; do
    for module in "$prefix"/{lib,local/lib}/python3*/*-packages/rclpy/_rclpy_pybind11.cpython-3*; do
      [ -e "$module" ] || continue
      ros_python=${module##*.cpython-3}
      ros_python=3.${ros_python%%-*}
      break 2
    done
  done
  [ -n "$ros_python" ] || lacking "the sourced ROS 2 Jazzy holds no rclpy for CPython: reinstall it, on Ubuntu with \
'sudo apt install --reinstall ros-jazzy-rclpy'."
elif [ "$(uname -s)-$(uname -m)" != Linux-x86_64 ]; then
  lacking "ROS 2 Jazzy comes as wheels for Linux on x86-64 only, and this is $(uname -s) on $(uname -m): \
install ROS 2 Jazzy and source its setup.bash first."
fi

# Compilers and CMake, for the messages.
command -v "${CC:-cc}" >/dev/null || lacking "no C compiler (${CC:-cc}) was found: \
install one, on Debian or Ubuntu with 'sudo apt install build-essential'."
command -v "${CXX:-c++}" >/dev/null || lacking "no C++ compiler (${CXX:-c++}) was found: \
install one, on Debian or Ubuntu with 'sudo apt install build-essential'."
command -v cmake >/dev/null || lacking "CMake was not found: \
install it, on Debian or Ubuntu with 'sudo apt install cmake'."

# Python: the first that will do; failing that, what the best of them lacks.
if [ -n "${PYTHON:-}" ]; then
  candidates=("$PYTHON")
  command -v "$PYTHON" >/dev/null || lacking "PYTHON=$PYTHON is not a program: name a Python 3.10 to 3.13, or leave PYTHON unset."
elif [ -n "$ros_python" ]; then
  candidates=("python$ros_python" python3)
else
  candidates=(python3 python3.12 python3.13 python3.11 python3.10)
fi
best= seen=
for candidate in "${candidates[@]}"; do
  answer=$("$candidate" - <<<"$probe" 2>/dev/null) || continue
  read -r state version interpreter <<<"$answer"
  [ -z "$ros_python" ] || [ "$version" = "$ros_python" ] || state=ros
  case $state in
  ok) printf '%s\n' "$interpreter" && exit 0 ;;
  version | ros) seen="$seen${seen:+, }$candidate is $version" ;;
  *) best=${best:-$state $version $candidate} ;;
  esac
done
read -r state version candidate <<<"$best"
case $state in
venv) lacking "$candidate cannot make virtual environments: \
install its venv module, on Debian or Ubuntu with 'sudo apt install python$version-venv'." ;;
headers) lacking "the C headers of $candidate are missing, and the messages need them: \
install them, on Debian or Ubuntu with 'sudo apt install python$version-dev'." ;;
esac
seen=${seen:-there is none}
[ -z "$ros_python" ] || lacking "the sourced ROS 2 Jazzy is built for Python $ros_python ($seen): \
install that one or name it with PYTHON=/path/to/python$ros_python."
lacking "no CPython 3.10 to 3.13 was found ($seen): install one, on Debian or Ubuntu with \
'sudo apt install python3 python3-venv python3-dev', or name it with PYTHON=/path/to/python3."
