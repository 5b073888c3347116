"""Tools for rosbag2 recordings: record, play, describe and export."""
