"""The laws, equation by equation."""
