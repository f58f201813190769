"""What `B1_rotflex.py` needs beside its tables: structures with names, and figures."""
