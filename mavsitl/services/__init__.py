"""MAVLink microservices as pure step functions, the server and the client half of each side by side."""
