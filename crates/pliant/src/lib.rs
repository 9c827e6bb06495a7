//! Soft bodies that several people can hold, feel and watch at once, over networks that lose packets.
