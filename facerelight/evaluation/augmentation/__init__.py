"""What RandomFaceRelight is worth: a small network trained under few lights, and the fast path beside the exact one."""
