"""Soak tests: hours of operation with all servers, monitored for growth in memory, descriptors, threads and delays."""
