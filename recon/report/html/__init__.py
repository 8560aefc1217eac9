"""report.html: what a folder of results holds, on one page that opens offline."""
