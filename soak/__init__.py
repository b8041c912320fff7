"""Soak tests: hours of operation with all servers, monitored for growth of memory, descriptors, threads and delays."""
