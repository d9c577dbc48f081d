"""What the command line does, as Python functions: values in, values out, nothing printed."""
