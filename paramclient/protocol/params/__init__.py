"""The parameter protocol of one component: table, reads, writes, downloads, hash check, sync."""
