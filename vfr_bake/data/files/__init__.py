"""Reading of users' files within limits: pictures, masks, ZIPs and videos."""
