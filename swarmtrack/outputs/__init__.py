"""What people see of a flight: console, pictures, Foxglove, notices to the pilot."""
