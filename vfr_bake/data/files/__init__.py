"""Files of people, which are read within limits: pictures and videos."""
