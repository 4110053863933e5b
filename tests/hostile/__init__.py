"""What strangers may send, and what the vehicle makes of it: each program prints demand and figure."""
