"""Write a run or a map in other programs' formats. `formats` lists them; each other module writes one."""
