"""What a level of a pyramid says about the next finer one."""
