# docker build -t gpebo . ;  docker run --rm -v "$PWD:/work" gpebo run plant=circuit estimator=drem
FROM python:3.13-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.13-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl
WORKDIR /work
ENTRYPOINT ["gpebo"]
CMD ["--help"]
