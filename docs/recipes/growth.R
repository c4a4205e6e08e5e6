# A logistic mixed model of leaf area from growth.csv of mvseg track; every leaf has a final size of its own.
library(nlme)
growth <- subset(read.csv("tracks/growth.csv"), trait == "area")
growth$leaf <- interaction(growth$plant, growth$track)
model <- nlme(value ~ SSlogis(time, Asym, xmid, scal), data = growth,
              fixed = Asym + xmid + scal ~ 1, random = Asym + xmid ~ 1 | leaf,
              weights = varFixed(~ sd^2), start = c(5000, 6, 2))
summary(model)
