#!/usr/bin/env bash
# Write the pinned lists beside this script anew, for Linux, from the .in files; needs .venv's uv (make build).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
uv=${UV:-../../../.venv/bin/uv}

# lock <name> <oldest Python> <option>...
lock() {
  local name=$1 python=$2
  shift 2
  "$uv" pip compile --quiet --universal --python-version "$python" --fork-strategy fewest --upgrade \
    --no-header --no-annotate "$@" "$name.in" |
    sed -e "/sys_platform == 'win32'/d" -e "s/ ; sys_platform != 'win32'$//" >"$name.txt.new"
  mv "$name.txt.new" "$name.txt"
}

lock jaxmarl 3.11
lock benchmarl 3.10 --override without.txt
lock mpe2 3.10
