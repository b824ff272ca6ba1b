"""Write a run or a map in other programs' formats. `formats.FORMATS` lists them; each other module writes one."""
