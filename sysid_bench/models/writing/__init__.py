"""Writing of identified parameters into URDF and MJCF files, with a round-trip check.

urdf_writer.py and mjcf_writer.py are the entries; update.py refuses what must not be written."""
