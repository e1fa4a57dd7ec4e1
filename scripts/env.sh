# Put .venv and the built packages on this shell's paths, after `make build`; bash and zsh:
#     . scripts/env.sh
# Where `make build` used a ROS 2 Jazzy installation, source that one first here too.

if [ -n "${ZSH_VERSION:-}" ]; then
  eval '_dae_ros_root=${${(%):-%x}:A:h:h}'
  _dae_ros_shell=zsh
else
  _dae_ros_root=$(builtin cd "$(dirname "${BASH_SOURCE[0]}")/.." >/dev/null && pwd -P)
  _dae_ros_shell=bash
fi

_dae_ros_lacks=
if [ ! -f "$_dae_ros_root/.venv/bin/activate" ]; then
  _dae_ros_lacks="$_dae_ros_root has no .venv: run 'make build' there first."
elif [ ! -d "$_dae_ros_root/.venv/share/ament_index" ] && [ "${ROS_DISTRO:-}" != jazzy ]; then
  _dae_ros_lacks="its .venv goes with a ROS 2 Jazzy installation: source that one first."
fi
if [ -n "$_dae_ros_lacks" ]; then
  echo "dae_ros: $_dae_ros_lacks" >&2
  unset _dae_ros_lacks _dae_ros_root _dae_ros_shell
  return 1
fi

. "$_dae_ros_root/.venv/bin/activate"
if [ -d "$VIRTUAL_ENV/share/ament_index" ]; then
  # The wheels make .venv a ROS prefix.
  case ":${AMENT_PREFIX_PATH:-}:" in
  *":$VIRTUAL_ENV:"*) ;;
  *)
    export AMENT_PREFIX_PATH="$VIRTUAL_ENV${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
    export CMAKE_PREFIX_PATH="$VIRTUAL_ENV${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}"
    ;;
  esac
  # Set by another environment's Python, this would keep ours from finding the wheels' libraries.
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
fi
if [ -f "$_dae_ros_root/install/local_setup.$_dae_ros_shell" ]; then
  . "$_dae_ros_root/install/local_setup.$_dae_ros_shell"
fi
unset _dae_ros_lacks _dae_ros_root _dae_ros_shell
