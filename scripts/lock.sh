#!/usr/bin/env bash
# Write requirements/python.txt, ros.txt and smax.txt anew: every package pinned, for CPython 3.10 to 3.13 at once.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# lock <name> <oldest Python> <package to leave out>...
lock() {
  local name=$1 python=$2 package leave_out=()
  shift 2
  for package; do leave_out+=(--no-emit-package "$package"); done
  # The fewest versions: one numpy for all interpreters where there is one, so results differ by less.
  .venv/bin/uv pip compile --quiet --universal --python-version "$python" --fork-strategy fewest --upgrade \
    --no-header --no-annotate "${leave_out[@]}" "requirements/$name.in" |
    sed -e "/sys_platform == 'win32'/d" -e "s/ ; sys_platform [!=]= '[a-z0-9]*'$//" \
      -e "s/ and sys_platform [!=]= '[a-z0-9]*'$//" >"requirements/$name.txt.new"
  mv "requirements/$name.txt.new" "requirements/$name.txt"
}

# colcon-core declares pytest plugins that only `colcon test` would use; coverage slows every start of Python.
lock python 3.10 coverage pytest-cov pytest-repeat pytest-rerunfailures
# These come from python.txt, in the versions that fit everything else.
lock ros 3.10 empy lark-parser numpy pyyaml setuptools
# In the versions of python.txt where both need a package; JAX has none for CPython 3.10.
lock smax 3.11
