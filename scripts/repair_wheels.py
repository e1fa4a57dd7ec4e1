"""Make the CMake files of the ROS wheels in this environment name its Python's and numpy's include folders.

The wheels name those of the machine they were built on, which exist nowhere else.
"""
import os
import re
import sys
import sysconfig
from pathlib import Path

import numpy

INCLUDE_FOLDERS = (
    (re.compile(r'/[^;"]*/include/python3\.\d+'), sysconfig.get_path('include')),
    (re.compile(r'/[^;"]*/numpy/_?core/include'), numpy.get_include()),
)


def main():
    for path in Path(sys.prefix).glob('share/*/cmake/*Export*.cmake'):
        before = after = path.read_text()
        for pattern, folder in INCLUDE_FOLDERS:
            after = pattern.sub(folder, after)
        if after != before:
            # A new file, because the installed one may be a hard link into an installer's cache.
            new = path.with_suffix('.new')
            new.write_text(after)
            os.replace(new, path)


if __name__ == '__main__':
    main()
