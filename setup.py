"""Install the library dae_ros, the nodes (from nodes/, as dae_ros_nodes) and their executables."""
from glob import glob

from setuptools import find_packages, setup

EXECUTABLES = ('agent', 'bringup', 'credit', 'export_policy', 'parameter_server', 'player', 'recorder', 'replay_trainer',
               'robot', 'robot_bridge', 'stream_trainer', 'task_monitor', 'train_reward', 'trainer', 'world')

setup(
    name='dae_ros',
    version='0.1.0',
    packages=find_packages(include=['dae_ros', 'dae_ros.*']) + ['dae_ros_nodes'],
    package_dir={'dae_ros_nodes': 'nodes'},
    package_data={'dae_ros.learning.native': ['*.c']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/dae_ros']),
        ('share/dae_ros', ['package.xml']),
        ('share/dae_ros/config', sorted(glob('config/*.yaml') + glob('config/*.xml'))),
        ('share/dae_ros/config/policies', sorted(glob('config/policies/*.safetensors'))),
        ('share/dae_ros/config/bags', sorted(glob('config/bags/*.yaml'))),
        ('share/dae_ros/config/smac', sorted(glob('config/smac/*.yaml'))),
        ('share/dae_ros/config/rviz', ['config/rviz/team.rviz']),
        ('share/dae_ros/config/foxglove', ['config/foxglove/team.json']),
        ('share/dae_ros/config/sros2', sorted(glob('config/sros2/*.xml'))),
        ('share/dae_ros/launch', sorted(glob('launch/*.py'))),
    ],
    python_requires='>=3.10',
    install_requires=['matplotlib', 'numpy', 'pillow', 'pyyaml', 'rich', 'rosbags', 'safetensors', 'tensorboard', 'torch'],
    extras_require={'onnx': ['onnx'], 'smax': ['jaxmarl==0.2.0']},
    zip_safe=False,
    author='dae_ros maintainers',
    author_email='dae_ros@example.org',
    maintainer='dae_ros maintainers',
    maintainer_email='dae_ros@example.org',
    description='Trains and runs cooperative robot teams over a ROS 2 graph.',
    license='Apache-2.0',
    entry_points={'console_scripts': [f'{name} = dae_ros_nodes.{name}:main' for name in EXECUTABLES]},
)
