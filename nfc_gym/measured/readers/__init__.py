"""Tables of logged columns, one file format a module; other formats are added with `register_reader`.

Files whose columns share one time: CSV, Parquet, npz, MATLAB, Minari data sets (an episode is a log). Files of several
streams, each with its own times (`Streams`): rosbag2 folders, `.db3`, MCAP, ROS 1 bags, PX4 ULog.
"""

from nfc_gym.measured.readers.csv_file import read_csv
from nfc_gym.measured.readers.matlab import read_mat
from nfc_gym.measured.readers.minari_set import episodes, read_episode
from nfc_gym.measured.readers.npz import read_npz
from nfc_gym.measured.readers.parquet import read_parquet
from nfc_gym.measured.readers.registry import (
    Reader,
    Table,
    is_log,
    log_parts,
    read_table,
    register_folder,
    register_parts,
    register_reader,
    suffixes,
)
from nfc_gym.measured.readers.rosbag import read_bag
from nfc_gym.measured.readers.streams import Stream, Streams
from nfc_gym.measured.readers.ulog import read_ulog

__all__ = [
    "Reader",
    "Stream",
    "Streams",
    "Table",
    "is_log",
    "log_parts",
    "read_table",
    "register_folder",
    "register_parts",
    "register_reader",
    "suffixes",
]

for _suffix, _reader, _selective in (
    (".csv", read_csv, True),
    (".parquet", read_parquet, True),
    (".npz", read_npz, True),
    (".mat", read_mat, False),
    (".ulg", read_ulog, False),
    (".db3", read_bag, True),
    (".mcap", read_bag, True),
    (".bag", read_bag, True),
):
    register_reader(_suffix, _reader, _selective)
register_folder("metadata.yaml", read_bag, selective=True)
register_parts(".hdf5", episodes, read_episode)
for _marker in ("main_data.hdf5", "data/metadata.json"):
    register_folder(_marker, read_episode, episodes)
