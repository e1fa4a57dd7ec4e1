#!/usr/bin/env bash
# Make .venv, install what requirements/ pins, build both packages; skip whatever is already as it should be.
# What is done is written last, into .venv/.dae_ros and install/.dae_ros, so an interrupted set-up is redone.
# With --done it only says, by its status, whether everything is.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$(pwd -P)
venv=$root/.venv

# One set-up at a time: several shells may ask for it at once.
if command -v flock >/dev/null; then
  exec 9<Makefile
  flock 9
fi

# Which ROS: the sourced one, told by its prefixes without those of this folder, or the wheels.
ros=wheels
if [ -n "${ROS_DISTRO:-}" ] && [ -n "${AMENT_PREFIX_PATH:-}" ]; then
  ros=$ROS_DISTRO
  IFS=: read -ra prefixes <<<"$AMENT_PREFIX_PATH"
  for prefix in "${prefixes[@]}"; do
    case $prefix in "$root"/*) ;; *) ros=$ros:$prefix ;; esac
  done
fi

# What each part depends on. Python sources are not among it: --symlink-install uses them where they lie.
installation() { echo "$root $ros" && cat requirements/*.txt scripts/setup.sh scripts/repair_wheels.py; }
build_inputs() {
  installation
  find config launch -name '*.yaml' -o -name '*.xml' -o -name '*.py' | LC_ALL=C sort
  find msg_schemas resource -type f | LC_ALL=C sort | while read -r file; do echo "$file" && cat "$file"; done
  cat setup.py setup.cfg package.xml
}
installed=$(installation | cksum)
built=$(build_inputs | cksum)

# .venv/.dae_ros: the installation's checksum, the interpreter, the folder and its ROS.
recorded() { sed -n "$1p" "$venv/.dae_ros" 2>/dev/null || true; }
is_installed() { [ -x "$venv/bin/python" ] && [ "$(recorded 1)" = "$installed" ] && [ "${python:-$(recorded 2)}" = "$(recorded 2)" ]; }
is_built() { [ "$(cat install/.dae_ros 2>/dev/null)" = "$built" ]; }

python=
[ -z "${PYTHON:-}" ] || python=$(scripts/check.sh)
is_installed && is_built && exit 0
[ "${1:-}" != --done ] || exit 1

if [ -z "$python" ] && [ "$(recorded 3)" = "$root $ros" ] && [ -x "$(recorded 2)" ]; then
  PYTHON=$(recorded 2)
  export PYTHON
fi
python=$(scripts/check.sh)
say() { printf '[%3d s] %s\n' "$SECONDS" "$1"; }

# Byte code saves every process seconds at its start, and the processes of a graph start together.
unset PYTHONDONTWRITEBYTECODE
# Set by another environment's Python, this would keep ours from finding the wheels' libraries.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
[ "$ros" != wheels ] || unset PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH

torch=
stop() { [ -z "$torch" ] || kill -- "-$torch" 2>/dev/null || true; }
trap stop EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

# Where the machine has a list of whom it trusts, uv goes by it, as pip does: it may hold a company's proxy.
[ ! -e /etc/ssl/certs/ca-certificates.crt ] || export UV_SYSTEM_CERTS="${UV_SYSTEM_CERTS:-true}"

pip() { "$venv/bin/python" -m pip --disable-pip-version-check -qq "$@"; }
uv() { "$venv/bin/uv" "$@" --quiet --python "$venv/bin/python"; }

make_venv() {
  local options=()
  # An installed ROS leans on the system's Python packages.
  [ "$ros" = wheels ] || options=(--system-site-packages)
  say "Creating .venv with $("$python" --version), $python"
  rm -rf "$venv" build install
  "$python" -m venv "${options[@]}" "$venv"
}

install_packages() {
  local lists=(requirements/python.txt) what="beside the sourced ROS 2 Jazzy"
  if [ "$ros" = wheels ]; then
    lists+=(requirements/ros.txt)
    what="with ROS 2 Jazzy as wheels"
  fi
  say "Installing $(cat "${lists[@]}" | wc -l) pinned packages, $what"
  lists=("${lists[@]/#/--requirement=}")
  # The lists are complete, so nothing is resolved. uv needs a tenth of pip's time; pip may know a mirror.
  if ! { pip install --no-deps -r requirements/uv.txt &&
    uv pip install --no-deps --build-constraints requirements/python.txt "${lists[@]}"; }; then
    say "uv could not install them: trying pip"
    PIP_CONSTRAINT=requirements/python.txt pip install --no-deps "${lists[@]}"
  fi
  [ "$ros" != wheels ] || "$venv/bin/python" scripts/repair_wheels.py
}

install_torch() {
  local pin
  pin=$(cat requirements/torch.txt)
  # A local version is matched exactly: pip finds a CPU build where it is configured for one, or nothing.
  pip install --no-deps --no-compile "$pin+cpu" && return
  # uv knows where CPU builds are kept; a quick look tells whether that can be reached from here.
  UV_HTTP_RETRIES=1 timeout 30 "$venv/bin/uv" pip install --quiet --python "$venv/bin/python" \
    --no-deps --torch-backend cpu --dry-run "$pin" &&
    uv pip install --no-deps --torch-backend cpu "$pin" && return
  say "No CPU build of $pin can be reached from here: installing the general one, with gigabytes of CUDA packages"
  pip install --no-compile -c requirements/python.txt "$pin"
}

# Import once what the nodes import, to leave its byte code, and dae_ros, to have its kernels compiled.
warm_up() {
  "$venv/bin/python" - <<'END'
import matplotlib.pyplot, rich.progress, safetensors.torch, torch, torch.utils.tensorboard, yaml

weight = torch.nn.Parameter(torch.zeros(1))
weight.sum().backward()
torch.optim.Adam([weight]).step()
END
  [ "$ros" != wheels ] || "$venv/bin/python" -c 'import diagnostic_msgs.msg, rclpy.node, std_srvs.srv'
  # A mistake in dae_ros is for its tests to show, not for set-up.
  "$venv/bin/python" -c 'import dae_ros.training' || true
}

build() {
  local log=log/setup_build.txt
  say "Building dae_ros_msgs and dae_ros"
  mkdir -p log
  if ! (
    export VIRTUAL_ENV=$venv PATH=$venv/bin:$PATH
    [ "$ros" != wheels ] || export AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv
    # Said here, because colcon's own choice makes way for whatever else the machine does.
    export MAKEFLAGS=-j$(nproc)
    colcon build --event-handlers console_cohesion+ \
      --cmake-args -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF "-DPython3_EXECUTABLE=$venv/bin/python"
  ) >"$log" 2>&1; then
    tail -n 40 "$log" >&2
    say "The build failed; $log holds all it said" >&2
    return 1
  fi
}

if ! is_installed; then
  say "Setting up dae_ros, once for this folder"
  if [ -x "$venv/bin/python" ] && [ "$(recorded 2)" = "$python" ] && [ "$(recorded 3)" = "$root $ros" ]; then
    say "requirements/ has changed since .venv was made"
    rm -rf "$venv/.dae_ros" build install
  else
    make_venv
  fi
  install_packages
  say "Installing torch for the CPU, and meanwhile:"
  # In a process group of its own, so that all of it ends with this script.
  set -m
  { install_torch && warm_up; } </dev/null 2>"$venv/torch.txt" &
  torch=$!
  set +m
fi

# Without its record, nobody knows how far a build got.
[ -e install/.dae_ros ] || rm -rf build install
rm -f install/.dae_ros
build && built_well=yes || built_well=

if [ -n "$torch" ]; then
  say "Waiting for torch"
  if ! wait "$torch"; then
    torch=
    tail -n 40 "$venv/torch.txt" >&2
    say "torch could not be installed" >&2
    exit 1
  fi
  torch=
  printf '%s\n' "$installed" "$python" "$root $ros" >"$venv/.dae_ros"
fi
[ -n "$built_well" ] || exit 1
echo "$built" >install/.dae_ros
say "Set-up is done"
