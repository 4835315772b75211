"""mcsim: is the isotropy violation I measure made by my instrument?"""
