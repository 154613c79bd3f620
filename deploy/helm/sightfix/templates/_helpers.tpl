{{- define "sightfix.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{/* Labels of a component: (list . "serve"). */}}
{{- define "sightfix.labels" -}}
app.kubernetes.io/name: sightfix
app.kubernetes.io/instance: {{ (index . 0).Release.Name }}
app.kubernetes.io/component: {{ index . 1 }}
{{- end }}

{{- define "sightfix.database" -}}
- name: SIGHTFIX_DATABASE
  valueFrom: { secretKeyRef: { name: {{ .Values.secretName }}, key: database } }
{{- end }}

{{- define "sightfix.adminKey" -}}
- name: SIGHTFIX_ADMIN_KEY
  valueFrom: { secretKeyRef: { name: {{ .Values.secretName }}, key: admin-key } }
{{- end }}

{{/* The program in a container that may do nothing else. */}}
{{- define "sightfix.container" -}}
image: {{ include "sightfix.image" . }}
imagePullPolicy: {{ .Values.image.pullPolicy }}
securityContext:
  runAsNonRoot: true
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: { drop: [ALL] }
  seccompProfile: { type: RuntimeDefault }
{{- end }}
