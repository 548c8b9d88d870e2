"""DROID-SLAM (Teed and Deng 2021) around the networks of mvsgs_core.networks.droid; the entry is droid.system."""
