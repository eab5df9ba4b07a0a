"""The slow focus loop as a running program: frames in, one record and one offset per exposure out."""
