"""Files of named arrays: NumPy, HDF5, MATLAB."""
