"""ROS 2 without ROS: its messages, their CDR and the DDS that carries them. Knows no message of this project."""
